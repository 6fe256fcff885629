"""The command ``doctor``.

The findings about Zenoh and LCM are in tests/unit/outputs/{zenoh,lcm}/test_checks.py.
"""

import json
import re
from pathlib import Path

from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.commands import Completed, run
from tests.support.errors import names
from tests.support.networks import free_port, zenoh_keys


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
    assert "FAIL  TCP " in done.stdout
    assert "→ " in done.stdout
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
    assert names(wrong["remedy"], "config/gateway.yaml")
    assert findings["source", "TCP"]["result"] == "not tested"
    assert findings["this computer", "clock"]["result"] in {"green", "warning", "not tested"}
