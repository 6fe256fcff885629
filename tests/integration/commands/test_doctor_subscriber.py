"""The command ``doctor --subscriber``: what reaches a computer behind two routers, and what is in the way."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import run
from tests.support.errors import names
from tests.support.networks import free_endpoint
from tests.support.routers import Routers, run_routers
from tests.support.secure_zenoh import run_gateway_with_simulator


@pytest.fixture
def routers() -> Iterator[Routers]:
    with run_routers() as routers:
        yield routers


async def doctor(*arguments: str) -> tuple[int, dict[tuple[str, str], dict[str, str]]]:
    """Return the exit status, and the findings by subject and check."""
    done = await run("doctor", "--subscriber", "--json", "--seconds", "1", *arguments)
    findings = json.loads(done.stdout)["findings"]
    return done.status, {(each["subject"], each["check"]): each for each in findings}


def client_of(endpoint: str) -> str:
    return f"{{mode: client, connect: {{endpoints: [{endpoint}]}}}}"


def only(key: str, freq_hz: float) -> list[dict[str, Any]]:
    """Return a rule that lets so many messages of a key leave a router for another one."""
    rules = [{"key_expr": key, "freq": freq_hz}]
    return [{"id": "rate", "messages": ["put"], "flows": ["egress"], "rules": rules}]


async def test_all_that_arrives_behind_two_routers_is_complete(routers: Routers, tmp_path: Path) -> None:
    routers.start("site-a")
    routers.start("site-b", linked_with="site-a")
    far = routers.endpoints["site-b"]
    with run_gateway_with_simulator(tmp_path, client_of(routers.endpoints["site-a"])):
        routers.client("site-b").declare_subscriber("mocap/lab/force", lambda _: None)
        status, found = await doctor("--connect", far)
        listed = await run("list", "--json", "--connect", far)
        missing, absent = await doctor("--connect", far, "--source", "hall")
        top = await run("top", "--once", "--json", "--connect", far)
    assert status == 0
    assert found["lab", "data"]["found"].endswith("none missing")
    assert found["zenoh", "carried"]["found"] == "site-a → site-b: mocap/lab/force"
    assert found["zenoh", "routers"]["found"].endswith("linked with site-a")
    for each in (listed, top):
        [source] = json.loads(each.stdout)["sources"]
        assert source["routers"] == ["site-a", "site-b"]
    assert missing == 1
    assert names(absent["zenoh", "gateway"]["found"], "'hall'")


async def test_what_a_router_leaves_out_is_missing_and_is_in_the_history(
    routers: Routers, tmp_path: Path
) -> None:
    routers.start("site-a", downsampling=only("mocap/lab/3d", 5))
    routers.start("site-b", linked_with="site-a")
    with run_gateway_with_simulator(tmp_path, client_of(routers.endpoints["site-a"])):
        status, found = await doctor("--connect", routers.endpoints["site-b"])
    data = found["lab", "data"]
    assert (status, data["result"]) == (0, "warning")
    assert names(data["found"], "missing", "history", "all")
    assert "site-a → site-b" in data["remedy"]


async def test_frames_that_do_not_arrive_at_all_fail(routers: Routers, tmp_path: Path) -> None:
    denied = {"id": "no", "permission": "deny", "flows": ["egress"], "messages": ["put", "reply"]}
    denied["key_exprs"] = [f"mocap/lab/{key}" for key in ("3d", "6d", "analog", "force", "event")]
    rules = {"enabled": True, "default_permission": "allow", "rules": [denied], "subjects": [{"id": "all"}]}
    rules["policies"] = [{"rules": ["no"], "subjects": ["all"]}]
    routers.start("site-a", access_control=rules)
    with run_gateway_with_simulator(tmp_path, client_of(routers.endpoints["site-a"])):
        status, found = await doctor("--connect", routers.endpoints["site-a"])
    assert (status, found["lab", "data"]["result"]) == (1, "red")
    assert names(found["lab", "data"]["found"], "gateway", "no message")


async def test_a_router_that_does_not_run_fails() -> None:
    endpoint = free_endpoint()
    status, found = await doctor("--connect", endpoint)
    assert status == 1
    assert found["zenoh", "link"]["result"] == "red"
    assert found["zenoh", "gateway"]["result"] == "not tested"


@pytest.mark.parametrize("arguments", [("--server", "127.0.0.1"), ("--no-connect",)])
async def test_options_of_the_other_doctor_are_refused(arguments: tuple[str, ...]) -> None:
    done = await run("doctor", "--subscriber", *arguments)
    assert (done.status, "--subscriber" in done.stderr) == (2, True)


async def test_options_of_a_subscriber_are_refused_without_it() -> None:
    done = await run("doctor", "--server", "127.0.0.1", "--connect", "tcp/127.0.0.1:1")
    assert (done.status, "--subscriber" in done.stderr) == (2, True)
