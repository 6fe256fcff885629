"""Which routers are between a gateway and a subscriber, and what the doctor says about them: real routers."""

import json
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version

import pytest
import zenoh

from gateway.outputs.findings import Result
from gateway.outputs.zenoh.router_checks import carried, check_routers, why_absent
from gateway.outputs.zenoh.routers import RouterNetwork, read_routers
from tests.support.errors import names
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.routers import Routers, run_routers
from tests.support.waiting import wait_until


@pytest.fixture
def routers() -> Iterator[Routers]:
    with run_routers() as routers:
        yield routers


def reply_with(key: str, text: bytes, query: zenoh.Query) -> None:
    query.reply(key, text)


def network_with(session: zenoh.Session, count: int) -> RouterNetwork:
    """Return the routers once ``count`` of them answer."""
    wait_until(lambda: len(read_routers(session, 5.0).routers) == count)
    return read_routers(session, 5.0)


def test_the_shortest_way_is_in_the_direction_of_the_data(routers: Routers) -> None:
    for name, other in (("a", None), ("b", "a"), ("c", "b")):
        routers.start(name, linked_with=other)
    gateway, near, far = routers.client("a"), routers.client("a"), routers.client("c")
    gateway_id = str(gateway.info.zid())
    assert network_with(far, 3).names_from(gateway_id) == ["a", "b", "c"]
    assert network_with(near, 3).names_from(gateway_id) == ["a"]
    assert network_with(far, 3).names_from("0123") is None


def test_a_gateway_with_a_link_of_its_own_has_no_routers_between() -> None:
    endpoint = free_endpoint()
    with open_zenoh("peer", listen=endpoint) as gateway, open_zenoh("peer", connect=endpoint) as subscriber:
        wait_until(lambda: read_routers(subscriber, 5.0).names_from(str(gateway.info.zid())) == [])


def test_what_answers_in_the_name_of_a_router_and_is_no_description_is_left_out(routers: Routers) -> None:
    router = routers.start("a")
    session, liar = routers.client("a"), routers.client("a")
    own = next(iter(network_with(session, 1).routers.values()))
    answers = [
        *(b"", b"[" * 100_000, b"[]", b"{}", b'{"zid": 1, "sessions": [], "locators": [], "version": ""}'),
        *(b'{"zid": "f00", "sessions": [{}]}', bytes(2_000_000)),
        json.dumps({"zid": own.zid, "version": "9", "sessions": [], "locators": []}).encode(),
    ]
    for number, text in enumerate(answers):
        key = f"@/f00{number}/router"
        liar.declare_queryable(key, partial(reply_with, key, text))
    wait_until(lambda: len([*session.get("@/*/router")]) > len(answers))
    assert read_routers(session, 5.0).routers == {own.zid: own}
    assert own.zid == str(router.info.zid())


def test_routers_and_what_is_behind_them_are_described(routers: Routers) -> None:
    routers.start("a")
    routers.start("b", linked_with="a")
    [finding] = check_routers(network_with(routers.client("b"), 2))
    assert finding.result is Result.PASSING
    running = version("eclipse-zenoh")
    assert names(finding.found, "b", running, "linked with a")


def test_two_routers_without_a_link_are_a_warning(routers: Routers) -> None:
    routers.start("a")
    routers.start("b")
    session = routers.peer("a", "b")
    wait_until(lambda: len(read_routers(session, 5.0).routers) == 2)
    network = read_routers(session, 5.0)
    network.routers = {zid: each._replace(routers=frozenset()) for zid, each in network.routers.items()}
    warning, passing = check_routers(network)
    assert warning.result is Result.WARNING
    assert names(warning.found, "a", "b")
    assert passing.result is Result.PASSING


def test_an_old_router_is_a_warning(routers: Routers) -> None:
    routers.start("a")
    network = network_with(routers.client("a"), 1)
    network.routers = {zid: each._replace(version="1.8.2") for zid, each in network.routers.items()}
    warning, _ = check_routers(network)
    assert (warning.result, warning.found) == (Result.WARNING, "the router a runs Zenoh 1.8.2")


def test_a_router_without_a_gateway_and_without_a_link_explains_why_none_is_found(routers: Routers) -> None:
    routers.start("a")
    session = routers.client("a")
    absence = why_absent(session, network_with(session, 1), "mocap", ["lab"], 5.0)
    assert absence is not None
    assert names(absence.reason, "lab", "a")
    assert not absence.is_hidden


def test_a_gateway_that_access_control_hides_is_named(routers: Routers) -> None:
    """The router knows its token. Only that distinguishes it from a gateway that does not run."""
    denied = {"id": "no", "permission": "deny", "flows": ["egress"], "key_exprs": ["mocap/**"]}
    denied["messages"] = ["liveliness_token"]
    rules = {"enabled": True, "default_permission": "allow", "rules": [denied], "subjects": [{"id": "all"}]}
    rules["policies"] = [{"rules": ["no"], "subjects": ["all"]}]
    routers.start("a", access_control=rules)
    gateway, session = routers.client("a"), routers.client("a")
    with gateway.liveliness().declare_token("mocap/lab/alive"):
        network = network_with(session, 1)
        assert not [*session.liveliness().get("mocap/*/alive")]
        wait_until(lambda: (found := why_absent(session, network, "mocap", ["lab"], 5.0)) and found.is_hidden)
        absence = why_absent(session, network, "mocap", ["lab"], 5.0)
        assert absence is not None
        assert names(absence.reason, "a", "lab")
        other = why_absent(session, network, "mocap", ["hall"], 5.0)
        assert other is not None
        assert not other.is_hidden


def test_what_crosses_a_link_are_the_subscriptions_behind_it(routers: Routers) -> None:
    routers.start("a")
    routers.start("b", linked_with="a")
    gateway, near, far = routers.client("a"), routers.client("a"), routers.client("b")
    near.declare_subscriber("mocap/lab/force", lambda _: None)
    far.declare_subscriber("mocap/lab/3d", lambda _: None)
    network = network_with(far, 2)
    way = network.way_from(str(gateway.info.zid()))
    assert way is not None
    wait_until(lambda: carried(far, network, way, 5.0) == [("a → b", ["mocap/lab/3d"])])
