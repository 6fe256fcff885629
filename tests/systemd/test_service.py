"""The service under systemd: start, watchdog, kill, reload and stop."""

import asyncio
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from gateway.outputs.zenoh.output import TEXTS
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.fresh_clones import ROOT
from tests.support.networks import free_endpoint, free_port, zenoh_keys
from tests.support.servers import Client, ScriptedServer, ok, packet
from tests.support.waiting import wait_until_async
from tests.systemd.machine import CONFIG, UNIT, Service

pytestmark = [
    pytest.mark.systemd,
    pytest.mark.wheelhouse,
    pytest.mark.netns,
]

STATE = "/var/lib/rtc3d-gateway"
STRAY = "/var/tmp"


def simulator(port: int = 0) -> Simulator:
    return Simulator(SyntheticScene(markers=2, tools=0, analog=0, plates=0, rate_hz=100), port=port)


async def test_the_status_line_shows_every_source_and_a_missing_router_delays_nothing(
    service: Service,
) -> None:
    away = free_port()
    async with simulator() as server:
        router = {"config": zenoh_keys("client", connect=service.endpoint)}
        service.configure({"lab": away, "sim": server.port}, zenoh=router)
        await service.start()
        await service.wait_for_status(f"zenoh: {TEXTS.cannot_open}")
        await service.wait_for_status("sim: streaming")
        await service.wait_for_status(f"lab: waiting for 127.0.0.1:{away}, ")
        status = await service.machine.show("StatusText")
        assert re.search(rf"lab: [^;]*127\.0\.0\.1:{away}, \d+ [^;]*; sim: [^;]*\d+\.\d Hz", status)
        assert await service.machine.show("ActiveState") == "active"


async def test_multicast_and_metrics_work_in_the_sandbox(service: Service) -> None:
    port = free_port()
    async with simulator() as server:
        service.configure(
            {"lab": server.port}, zenoh={"config": {}}, lcm={"enabled": True}, metrics={"port": port}
        )
        await service.start()
        await service.wait_for_status("lab: streaming")
        assert not re.search("zenoh|lcm", await service.machine.show("StatusText"))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
        page = (await reader.read()).decode()
        writer.close()
        assert 'rtc3d_gateway_messages_total{component="3d",output="lcm",source="lab"}' in page
        assert "process_resident_memory_bytes" in page


@pytest.mark.parametrize(
    ("restarts", "delay_s"), [(0, None), (1, 1), (2, 2), (3, 4), (4, 8), (5, 16), (6, 16), (100, 16)]
)
def test_each_restart_in_a_row_waits_longer(restarts: int, delay_s: int | None) -> None:
    unit = (ROOT / "systemd" / UNIT).read_text()
    [line] = re.findall(r"^ExecStartPre=\+(.*)$", unit, re.MULTILINE)
    *shell, script = shlex.split(line.replace("$$", "$"))
    stubs = f"systemctl() {{ echo {restarts}; }}; sleep() {{ echo slept $1; }};"
    output = subprocess.check_output([*shell, stubs + script], text=True)
    assert output == ("" if delay_s is None else f"slept {delay_s}\n")


async def test_a_killed_service_and_one_that_hangs_are_restarted(service: Service) -> None:
    machine = service.machine
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.drop_in("WatchdogSec=5s")  # so long that a busy machine does not trip it
        await service.start()
        for restarts, signal in (("1", "-KILL"), ("2", "-STOP")):
            await service.wait_for_status("lab: streaming")
            before = await service.main_pid()
            await machine.run("kill", signal, before)
            await machine.wait_for("NRestarts", restarts)
            await machine.wait_for("ActiveState", "active")
            await service.wait_for_status("lab: streaming")
            assert await service.main_pid() != before
    log = (await machine.run("journalctl", "--output=cat", "--unit", UNIT)).text
    assert "Watchdog timeout" in log
    assert "Fatal Python error: Aborted" in log  # and the traceback shows where it hung


async def test_the_limits_are_in_force_and_journal_entries_have_fields(service: Service) -> None:
    machine = service.machine
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        await service.wait_for_status("lab: streaming")
    [entry] = [entry for entry in await machine.journal() if "connected to" in entry["MESSAGE"]]
    assert (entry["SOURCE"], entry["PEER"]) == ("lab", f"127.0.0.1:{server.port}")
    assert (entry["STREAM"], entry["PRIORITY"]) == ("3d 6d analog force event", "6")
    pid = await service.main_pid()
    limits = (await machine.run("cat", f"/proc/{pid}/limits")).text
    assert re.search(r"Max open files +8192 +8192 ", limits)
    assert await machine.show("OOMScoreAdjust") == "-500"  # containers may not apply it
    assert await machine.show("MemoryHigh") == str(1536 * 2**20)
    assert await machine.show("MemoryMax") == str(2 * 2**30)
    assert await machine.show("TasksMax") == "1024"
    assert "time-sync.target" in (await machine.show("After")).split()
    assert "time-sync.target" not in (await machine.show("Wants")).split()
    # Which controllers version 2 of cgroups has depends on the outer machine.
    folder = f"/sys/fs/cgroup{await machine.show('ControlGroup')}"
    controllers = (await machine.run("cat", f"{folder}/cgroup.controllers")).text.split()
    expected = {"memory": ("memory.max", str(2 * 2**30)), "pids": ("pids.max", "1024")}
    for file, value in (expected[name] for name in controllers if name in expected):
        assert (await machine.run("cat", f"{folder}/{file}")).text.strip() == value


async def test_a_bad_configuration_is_refused_and_the_old_one_stays_in_use(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        await service.wait_for_status("lab: streaming")
        [connection] = server.connections
        file = service.machine.path(CONFIG)
        good = file.read_text()
        file.write_text(f"{good}bogus: 1\n")
        assert (await service.reload()).status != 0  # so that scripts notice it
        place = f"{CONFIG}:{len(good.splitlines()) + 1}:1"
        await service.wait_for_status(
            f"new configuration refused, the old one stays in use: {place}: bogus: unknown key"
        )
        assert await service.machine.show("ActiveState") == "active"
        errors = [entry for entry in await service.machine.journal() if entry["PRIORITY"] == "3"]
        assert any(place in entry["MESSAGE"] for entry in errors)
        file.write_text(good)
        assert (await service.reload()).status == 0
        await service.machine.wait_for("StatusText", "lab: streaming")
        assert "refused" not in await service.machine.show("StatusText")
        assert server.connections == {connection}


async def test_a_start_with_a_bad_configuration_fails_once_and_logs_why(service: Service) -> None:
    service.machine.write(CONFIG, "sources: []\n")
    started = await service.machine.run("systemctl", "start", UNIT, check=False)
    assert started.status != 0
    assert await service.machine.show("ActiveState") == "failed"
    assert await service.machine.show("ExecMainStatus") == "2"
    assert any(f"{CONFIG}:1:10" in entry["MESSAGE"] for entry in await service.machine.journal())


async def test_stopping_says_bye_to_a_server_that_never_closes(service: Service) -> None:
    commands: list[str] = []

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes | None:
            commands.append(command)
            return None if command == "Bye" else ok(f"OK-{command}")

        try:
            await client.commands(answer)
        finally:
            await asyncio.Event().wait()  # never closes

    async with ScriptedServer(script) as server, simulator() as simulated:
        service.configure({"lab": server.port, "sim": simulated.port})
        await service.drop_in("TimeoutStopSec=60s")  # then systemd kills it, and the result is a failure
        await service.start()
        await service.wait_for_status("sim: streaming")
        [connection] = simulated.connections
        await service.machine.run("systemctl", "stop", UNIT)
        assert commands[-1] == "Bye"
        assert connection.session.said_bye
    assert await service.machine.show("Result") == "success"
    assert await service.machine.show("ExecMainStatus") == "0"


async def test_instances_have_separate_configurations_and_state(service: Service) -> None:
    machine, instance = service.machine, "rtc3d-gateway@two.service"
    async with simulator() as one, simulator() as two:
        service.configure({"two": two.port})
        machine.path(CONFIG).rename(machine.path(CONFIG).with_name("two.yaml"))
        service.endpoint = free_endpoint()
        service.configure({"one": one.port})
        await service.start()
        await machine.run("systemctl", "start", instance)
        await service.wait_for_status("one: streaming")
        await machine.wait_for("StatusText", "two: streaming", instance)
        assert machine.path(f"{STATE}/two").is_dir()
        assert (await machine.run("systemctl", "reload", instance)).status == 0


def test_the_units_differ_only_in_the_name_of_the_configuration() -> None:
    one, other = (
        [line for line in (ROOT / "systemd" / name).read_text().splitlines() if not line.startswith("# ")]
        for name in (UNIT, "rtc3d-gateway@.service")
    )
    named = "\n".join(one).replace("gateway.yaml", "%i.yaml").replace("gateway.env", "%i.env")
    named = named.replace("Description=RTC3D gateway", "Description=RTC3D gateway of %i.yaml")
    named = named.replace("StateDirectory=rtc3d-gateway", "StateDirectory=rtc3d-gateway/%i")
    assert named == "\n".join(other)


C3D_FILE = b"\x02\x50" + bytes(510)
"""The header of a C3D file; the gateway refuses files without one."""


def file_server() -> ScriptedServer:
    """Return a server that sends a C3D file without a request."""

    async def script(client: Client) -> None:
        client.send(packet(5, C3D_FILE))
        await client.commands(lambda command: ok(f"OK-{command}"))

    return ScriptedServer(script)


async def kept_file(service: Service) -> Path:
    folder = service.machine.path(f"{STATE}/c3d")
    await wait_until_async(lambda: list(folder.glob("lab-*.c3d")))
    return next(folder.glob("lab-*.c3d"))


async def test_the_service_can_only_write_to_its_state_directory(service: Service) -> None:
    async with file_server() as server:
        service.configure({"lab": server.port})
        await service.start()
        assert (await kept_file(service)).read_bytes() == C3D_FILE
        mounts = await service.machine.run("cat", f"/proc/{await service.main_pid()}/mountinfo")
    # All mounts, but the kernel's file systems and the private /tmp do not count.
    mount_points = [line.split(maxsplit=6)[4:6] for line in mounts.text.splitlines()]
    writable = {path for path, options in mount_points if "rw" in options.split(",")}
    assert {path for path in writable if not re.match("/(proc|sys|dev|tmp|var/tmp)(/|$)", path)} == {STATE}


async def test_the_service_writes_nowhere_else_even_without_the_sandbox(service: Service) -> None:
    machine = service.machine
    async with file_server() as server:
        service.configure({"lab": server.port}, lcm={"enabled": True}, metrics={"port": free_port()})
        stray_file = f"{STRAY}/by-the-test"  # shows that the test would find a stray file
        await service.drop_in(
            *("ProtectSystem=no", "PrivateTmp=no", "ReadOnlyPaths=", "InaccessiblePaths="),
            *(f"ExecStopPost=/bin/touch {stray_file}",),
        )
        before = await machine.files()
        await service.start()
        await kept_file(service)
        assert (await service.reload()).status == 0
        await machine.run("systemctl", "stop", UNIT)
        after = await machine.files()
    changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    assert {path for path in changed if not path.startswith(STATE)} == {stray_file}
    assert any(path.startswith(f"{STATE}/c3d/lab-") for path in changed)
