"""The service under a systemd: started, watched, killed, reloaded, stopped."""

import asyncio
import re
import shlex
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.cli.subscribers import ZenohListener, key_pattern, open_zenoh
from gateway.messages.decode import decode
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.clones import ROOT
from tests.networks import free_endpoint, free_port, zenoh_keys
from tests.servers import Client, ScriptedServer, ok, packet
from tests.systemd.machine import CONFIG, UNIT, Service
from tests.waiting import wait_until_async

pytestmark = [pytest.mark.systemd, pytest.mark.wheelhouse, pytest.mark.netns]

STATE = "/var/lib/rtc3d-gateway"
STRAY = "/var/tmp"


def simulator(port: int = 0) -> Simulator:
    return Simulator(SyntheticScene(markers=2, tools=0, analog=0, plates=0, rate_hz=100), port=port)


async def test_the_service_says_how_its_sources_are(service: Service) -> None:
    away = free_port()
    async with simulator() as server:
        service.configure({"lab": away, "sim": server.port})
        await service.start()
        await service.says("sim: streaming")
        await service.says(f"lab: waiting for 127.0.0.1:{away}, ")
        said = await service.machine.show("StatusText")
        assert re.fullmatch(r"lab: waiting for [\d.:]+, \d+ (try|tries); sim: streaming \d+\.\d Hz", said)
        assert await service.machine.show("ActiveState") == "active"


async def test_a_server_may_be_switched_off_and_on(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        await service.says("lab: streaming")
        before = await service.main_pid()
    await service.says(f"lab: waiting for 127.0.0.1:{server.port}")
    async with simulator(server.port):
        await service.says("lab: streaming")
    assert await service.main_pid() == before


async def test_a_router_that_is_away_does_not_hold_up_the_start(service: Service) -> None:
    away = {"config": zenoh_keys("client", connect=service.endpoint)}
    async with simulator() as server:
        service.configure({"lab": server.port}, zenoh=away)
        await service.start()
        await service.says("lab: streaming")
        await service.says("zenoh: the Zenoh session does not open")


async def test_multicast_and_metrics_work_within_the_sandbox(service: Service) -> None:
    port = free_port()
    async with simulator() as server:
        service.configure(
            {"lab": server.port}, zenoh={"config": {}}, lcm={"enabled": True}, metrics={"port": port}
        )
        await service.start()
        await service.says("lab: streaming")
        assert not re.search("zenoh|lcm", await service.machine.show("StatusText"))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
        page = (await reader.read()).decode()
        writer.close()
        assert 'rtc3d_gateway_messages_total{component="3d",output="lcm",source="lab"}' in page
        assert "process_resident_memory_bytes" in page


async def test_a_killed_service_comes_back(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        before = await service.main_pid()
        await service.machine.run("kill", "-KILL", before)
        await service.machine.until("NRestarts", "1")
        await service.machine.until("ActiveState", "active")
        await service.says("lab: streaming")
        assert await service.main_pid() != before


@pytest.mark.parametrize(
    ("restarts", "delay_s"), [(0, None), (1, 1), (2, 2), (3, 4), (4, 8), (5, 16), (6, 16), (100, 16)]
)
def test_each_restart_in_a_row_waits_longer(restarts: int, delay_s: int | None) -> None:
    unit = (ROOT / "systemd" / UNIT).read_text()
    [line] = re.findall(r"^ExecStartPre=\+(.*)$", unit, re.MULTILINE)
    *shell, script = shlex.split(line.replace("$$", "$"))
    stubs = f"systemctl() {{ echo {restarts}; }}; sleep() {{ echo slept $1; }};"
    said = subprocess.check_output([*shell, stubs + script], text=True)
    assert said == ("" if delay_s is None else f"slept {delay_s}\n")


async def test_a_hung_service_is_found_by_the_watchdog(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.drop_in("WatchdogSec=1s")
        await service.start()
        await service.says("lab: streaming")
        before = await service.main_pid()
        await service.machine.run("kill", "-STOP", before)
        await service.machine.until("NRestarts", "1")
        await service.machine.until("ActiveState", "active")
        await service.says("lab: streaming")
        assert await service.main_pid() != before
    told = (await service.machine.run("journalctl", "--output=cat", "--unit", UNIT)).text
    assert "Watchdog timeout" in told
    assert "Fatal Python error: Aborted" in told  # and where it hung


class Heard:
    """What a Zenoh subscriber received of each source's markers: (session, sequence), in order."""

    def __init__(self) -> None:
        self.numbers: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)

    def take(self, key: str, message: bytes) -> None:
        markers = decode(message)
        self.numbers[key.split("/")[1]].append((markers.session, markers.sequence))

    async def more(self, source: str, count: int = 20) -> None:
        wanted = len(self.numbers[source]) + count
        await wait_until_async(lambda: len(self.numbers[source]) >= wanted)

    def assert_whole(self, source: str) -> None:
        sequences = [sequence for _, sequence in self.numbers[source]]
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


@contextmanager
def heard_on(endpoint: str) -> Iterator[Heard]:
    heard = Heard()
    session = open_zenoh(endpoint)
    try:
        ZenohListener(session, key_pattern("mocap", None, "3d"), heard.take)
        yield heard
    finally:
        session.close()


async def test_a_reload_changes_what_differs_and_nothing_else(service: Service) -> None:
    async with simulator() as kept, simulator() as first, simulator() as second, simulator() as new:
        service.configure({"kept": kept.port, "moved": first.port, "gone": first.port})
        await service.start()
        await service.says("gone: streaming")
        with heard_on(service.endpoint) as heard:
            await heard.more("kept")
            await heard.more("moved")
            [connection] = kept.connections
            service.configure({"kept": kept.port, "moved": second.port, "new": new.port})
            assert (await service.reload()).status == 0
            await heard.more("new")
            await heard.more("kept")
            await wait_until_async(lambda: heard.numbers["moved"][-1][0] == 2)
            heard.assert_whole("kept")
            heard.assert_whole("moved")  # another server, the same key: its numbers go on
            assert {session for session, _ in heard.numbers["kept"]} == {1}
            assert kept.connections == {connection}
            assert not first.connections
        await service.says("new: streaming")
        assert "gone" not in await service.machine.show("StatusText")


async def test_a_bad_configuration_is_refused_and_the_old_one_runs_on(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        await service.says("lab: streaming")
        with heard_on(service.endpoint) as heard:
            await heard.more("lab")
            file = service.machine.path(CONFIG)
            good = file.read_text()
            file.write_text(f"{good}bogus: 1\n")
            refused = await service.reload()
            await heard.more("lab")
            heard.assert_whole("lab")
        assert refused.status != 0  # so that who reloads it in a script notices
        line = len(good.splitlines()) + 1
        await service.says(
            f"new configuration refused, the old one stays in use: {CONFIG}:{line}:1: bogus: unknown key"
        )
        assert await service.machine.show("ActiveState") == "active"
        errors = [entry for entry in await service.machine.journal() if entry["PRIORITY"] == "3"]
        assert any(f"{CONFIG}:{line}:1" in entry["MESSAGE"] for entry in errors)
        file.write_text(good)
        assert (await service.reload()).status == 0
        await service.machine.until("StatusText", "lab: streaming")
        assert "refused" not in await service.machine.show("StatusText")


async def test_a_start_with_a_bad_configuration_fails_once_and_says_why(service: Service) -> None:
    service.machine.path(CONFIG).write_text("sources: []\n")
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
        await service.drop_in("TimeoutStopSec=2s")  # later it would be killed, and be a failure
        await service.start()
        await service.says("sim: streaming")
        [connection] = simulated.connections
        await service.machine.run("systemctl", "stop", UNIT)
        assert commands[-1] == "Bye"
        assert connection.session.said_bye
    assert await service.machine.show("Result") == "success"
    assert await service.machine.show("ExecMainStatus") == "0"


async def test_instances_have_configurations_and_state_of_their_own(service: Service) -> None:
    machine, instance = service.machine, "rtc3d-gateway@two.service"
    async with simulator() as one, simulator() as two:
        service.configure({"two": two.port})
        machine.path(CONFIG).rename(machine.path(CONFIG).with_name("two.yaml"))
        service.endpoint = free_endpoint()
        service.configure({"one": one.port})
        await service.start()
        await machine.run("systemctl", "start", instance)
        await service.says("one: streaming")
        await machine.until("StatusText", "two: streaming", instance)
        assert machine.path(f"{STATE}/two").is_dir()
        assert (await machine.run("systemctl", "reload", instance)).status == 0


def test_both_units_are_the_same_but_for_the_name_of_the_configuration() -> None:
    one, other = (
        [line for line in (ROOT / "systemd" / name).read_text().splitlines() if not line.startswith("# ")]
        for name in (UNIT, "rtc3d-gateway@.service")
    )
    named = "\n".join(one).replace("gateway.yaml", "%i.yaml").replace("gateway.env", "%i.env")
    named = named.replace("Description=RTC3D gateway", "Description=RTC3D gateway of %i.yaml")
    named = named.replace("StateDirectory=rtc3d-gateway", "StateDirectory=rtc3d-gateway/%i")
    assert named == "\n".join(other)


async def test_the_journal_has_fields(service: Service) -> None:
    async with simulator() as server:
        service.configure({"lab": server.port})
        await service.start()
        await service.says("lab: streaming")
    entries = [entry for entry in await service.machine.journal() if "streaming from" in entry["MESSAGE"]]
    assert [(entry["SOURCE"], entry["PEER"]) for entry in entries] == [("lab", f"127.0.0.1:{server.port}")]
    assert entries[0]["STREAM"] == "3d 6d analog force event"
    assert entries[0]["PRIORITY"] == "6"


def file_server() -> ScriptedServer:
    """Return a server that sends a C3D file by itself."""

    async def script(client: Client) -> None:
        client.send(packet(5, b"a C3D file"))
        await client.commands(lambda command: ok(f"OK-{command}"))

    return ScriptedServer(script)


async def kept_file(service: Service) -> Path:
    folder = service.machine.path(f"{STATE}/c3d")
    await wait_until_async(lambda: list(folder.glob("lab-*.c3d")))
    return next(folder.glob("lab-*.c3d"))


async def test_the_service_can_write_to_its_state_directory_alone(service: Service) -> None:
    async with file_server() as server:
        service.configure({"lab": server.port})
        await service.start()
        assert (await kept_file(service)).read_bytes() == b"a C3D file"
        mounts = await service.machine.run("cat", f"/proc/{await service.main_pid()}/mountinfo")
    # Where the service could write at all, the kernel's own file systems and its private /tmp aside.
    places = [line.split(maxsplit=6)[4:6] for line in mounts.text.splitlines()]
    writable = {path for path, options in places if "rw" in options.split(",")}
    assert {path for path in writable if not re.match("/(proc|sys|dev|tmp|var/tmp)(/|$)", path)} == {STATE}


async def test_the_service_writes_nowhere_else_even_where_it_could(service: Service) -> None:
    machine = service.machine
    async with file_server() as server:
        service.configure({"lab": server.port}, lcm={"enabled": True}, metrics={"port": free_port()})
        shown = f"{STRAY}/by-the-test"  # what a stray file would look like
        await service.drop_in(
            *("ProtectSystem=no", "PrivateTmp=no", "ReadOnlyPaths=", "InaccessiblePaths="),
            *(f"ExecStopPost=/bin/touch {shown}",),
        )
        before = await machine.files()
        await service.start()
        await kept_file(service)
        assert (await service.reload()).status == 0
        await machine.run("systemctl", "stop", UNIT)
        after = await machine.files()
    changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    assert {path for path in changed if not path.startswith(STATE)} == {shown}
    assert any(path.startswith(f"{STATE}/c3d/lab-") for path in changed)
