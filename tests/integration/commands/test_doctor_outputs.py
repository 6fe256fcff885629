"""What the doctor assumes about outputs and the kernel, and the command ``doctor``.

The findings about Zenoh and LCM are in tests/unit/outputs/{zenoh,lcm}/test_checks.py.
"""

import json
import re
import socket
from pathlib import Path
from typing import Any, Final

import pytest

from gateway.outputs.lcm.checks import charged_bytes
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.commands import Completed, run
from tests.support.networks import free_port, zenoh_keys

GROUP: Final = "udpm://239.255.76.67:7667"


@pytest.mark.parametrize("size", [200, 1500, 3000, 8000, 20_000, 60_000])
def test_the_kernel_charges_at_most_charged_bytes_for_a_datagram(size: int) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 150_000)
        count = receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // charged_bytes(size)
        assert count >= 1
        for _ in range(count):
            sender.sendto(bytes(size), receiver.getsockname())
        receiver.setblocking(False)
        assert [len(receiver.recv(size)) for _ in range(count)] == [size] * count


def test_large_messages_are_charged_per_datagram() -> None:
    assert charged_bytes(3 * 65_499) == 3 * charged_bytes(65_499)
    assert (charged_bytes(200), charged_bytes(1500)) == (1280, 2304)


@pytest.mark.parametrize(
    ("output", "settings", "leaves"),
    [
        ("zenoh", ZenohSettings(), True),
        ("zenoh", ZenohSettings(config={"scouting": {"multicast": {"enabled": False}}}), True),  # listens
        ("lcm", LcmSettings(url=f"{GROUP}?ttl=0"), False),
        ("lcm", LcmSettings(url=f"{GROUP}?ttl=1"), True),
        ("lcm", LcmSettings(url=GROUP), False),
        ("lcm", LcmSettings(url="memq://"), False),
        ("lcm", LcmSettings(url="tcpq://127.0.0.1:7700"), False),
        ("lcm", LcmSettings(url="tcpq://192.0.2.10:7700"), True),
    ],
)
def test_whether_an_output_leaves_this_computer(output: str, settings: Any, leaves: bool) -> None:
    assert OUTPUTS[output].leaves_host(settings) is leaves


async def doctor(*arguments: str) -> Completed:
    """Run the command; its Zenoh and LCM stay on this machine."""
    environ = {
        "RTC3D_GATEWAY__ZENOH__CONFIG": json.dumps(zenoh_keys("peer")),
        "RTC3D_GATEWAY__LCM__URL": "memq://",
        "RTC3D_GATEWAY__METRICS__PORT": str(free_port()),
        "COLUMNS": "80",
    }
    return await run("doctor", "--seconds", "0.3", *arguments, environ=environ)


async def test_without_a_failing_check_the_status_is_0() -> None:
    async with Simulator(SyntheticScene(markers=1, tools=0, analog=0, plates=0)) as simulator:
        done = await doctor("--server", f"127.0.0.1:{simulator.port}", "--json", "--seconds", "3")
    report = json.loads(done.stdout)
    assert (done.status, done.stderr, report["ok"]) == (0, "", True)
    assert "red" not in {each["result"] for each in report["findings"]}
    name = {"subject": "lab", "check": "name", "result": "green", "found": "127.0.0.1 is an IP address"}
    assert name | {"remedy": ""} in report["findings"]


async def test_a_failed_check_prints_its_remedy_and_exits_with_status_1() -> None:
    """-q prints only what needs attention, -v logs what is done, and neither is the default."""
    server = ("--server", f"127.0.0.1:{free_port()}")
    done, quiet = await doctor(*server), await doctor(*server, "-q")
    lines = done.stdout.splitlines()
    assert (done.status, done.stderr) == (1, "")
    assert "FAIL  TCP         connection refused by" in done.stdout
    assert "→ Is the RT server running, and is this its port?" in done.stdout
    assert max(map(len, lines)) <= 80
    assert all(line == line.rstrip() for line in lines)
    assert re.search(r"^\d+ ok, \d+ failed, \d+ not tested(, \d+ warnings?)?(, \d+ notes?)?$", lines[-1])
    assert quiet.status == 1
    marks = {line.split()[0] for line in quiet.stdout.splitlines() if re.match("  [^ ]", line)}
    assert {"FAIL"} <= marks <= {"FAIL", "warn"}
    assert "DEBUG" in (await doctor(*server, "-v")).stderr


async def test_an_invalid_configuration_fails(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text("sources: [{name: lab, host: lab, prot: 1}]\nspool: 1\n")
    done = await doctor("--config", str(file), "--json")
    findings = {(each["subject"], each["check"]): each for each in json.loads(done.stdout)["findings"]}
    assert done.status == 1
    wrong = findings["configuration", "file"]
    assert [line.split(":")[1] for line in wrong["found"].splitlines()] == ["1", "2"]
    assert wrong["remedy"] == "Correct these lines; config/gateway.yaml explains every key."
    assert findings["source", "TCP"]["found"] == "it needs the configuration, which failed"
    assert findings["this computer", "clock"]["result"] in {"green", "warning", "not tested"}
