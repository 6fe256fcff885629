"""The doctor's findings about Zenoh, with real sessions."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from gateway.outputs.findings import Finding, Result
from gateway.outputs.zenoh.checks import check_zenoh, leaves_host
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.errors import names
from tests.support.findings import is_finding
from tests.support.networks import free_endpoint, free_port, open_zenoh, zenoh_keys

ROUTER_REMEDY = ["zenohd", "connect/endpoints", "zenoh.config"]


def is_no_link(others: list[Finding]) -> bool:
    """Whether the other checks were not made, because they need the link."""
    return [
        is_finding(each, "zenoh", check, Result.NOT_TESTED, "link")
        for each, check in zip(others, ("routers", "gateway"), strict=True)
    ] == [True, True]


def found(config: dict[str, Any], *sources: str, prefix: str = "mocap") -> list[Finding]:
    settings = ZenohSettings.model_construct(config=config, prefix=prefix)
    return check_zenoh(settings, sources or ("lab",), (), 0.2)


def is_link_to(link: Finding, text: str) -> bool:
    return is_finding(link, "zenoh", "link", Result.PASSING, text)


def is_no_gateway(finding: Finding, *sources: str) -> bool:
    values = (", ".join(sources), "zenoh.prefix")
    return is_finding(finding, "zenoh", "gateway", Result.NOT_TESTED, *values)


def with_endpoints(**endpoints: Any) -> dict[str, Any]:
    """Return the configuration of a peer with these values of connect/endpoints and listen/endpoints."""
    keys = zenoh_keys("peer")
    for side, value in endpoints.items():
        keys[side]["endpoints"] = value
    return keys


@contextmanager
def session(mode: str, **endpoints: str) -> Iterator[zenoh.Session]:
    opened = open_zenoh(mode, **endpoints)
    yield opened
    opened.close()


@pytest.fixture
def gateway() -> Iterator[str]:
    """Run a peer that serves the sources lab and hall; return its endpoint."""
    endpoint = free_endpoint()
    with session("peer", listen=endpoint) as peer:
        tokens = [peer.liveliness().declare_token(f"mocap/{source}/alive") for source in ("lab", "hall")]
        yield endpoint
        for token in tokens:
            token.undeclare()


def test_a_configuration_that_zenoh_refuses_fails() -> None:
    link, *others = found({"mode": "clinet"})
    values = ("zenoh.config", "`clinet`")
    assert is_finding(link, "zenoh", "link", Result.FAILING, *values, remedy=["zenoh.config"])
    assert is_no_link(others)


def test_a_client_whose_router_does_not_run_fails() -> None:
    endpoint = free_endpoint()
    link, *others = found(zenoh_keys("client", connect=endpoint))
    assert is_finding(link, "zenoh", "link", Result.FAILING, endpoint, remedy=ROUTER_REMEDY)
    assert is_no_link(others)


def test_a_client_is_connected_to_a_router() -> None:
    endpoint = free_endpoint()
    with session("router", listen=endpoint):
        link, routers, gateway = found(zenoh_keys("client", connect=endpoint))
    assert is_link_to(link, "a router")
    assert names(routers.found, endpoint)
    assert names(gateway.found, "lab", endpoint)


def test_routers_and_peers_are_counted(gateway: str) -> None:
    endpoints = [gateway, free_endpoint(), free_endpoint(), free_endpoint()]
    with session("peer", listen=endpoints[1]), session("router", listen=endpoints[2]):
        link, *_ = found(with_endpoints(connect=endpoints[:3]), "cave")
        assert is_link_to(link, "1 router and 2 peers")
        with session("router", listen=endpoints[3]):
            link, *_ = found(with_endpoints(connect=endpoints[2:]), "cave")
            assert is_link_to(link, "2 routers and 0 peers")


def test_every_source_must_be_served(gateway: str) -> None:
    keys = zenoh_keys("peer", connect=gateway)
    assert is_finding(found(keys, "lab", "hall")[1], "zenoh", "gateway", Result.PASSING, "lab, hall")
    assert is_no_gateway(found(keys, "lab", "cave", "attic")[1], "cave", "attic")
    assert is_no_gateway(found(keys, "lab", prefix="site")[1], "lab")


def test_a_peer_that_reaches_nobody_fails_with_all_endpoints_and_without_secrets() -> None:
    first, second = free_endpoint(), f"tcp/127.0.0.1:{free_port()}#iface=lo"
    link, *others = found(with_endpoints(connect=[first, second]))
    values = (f"{first}, {second}",)
    assert is_finding(link, "zenoh", "link", Result.FAILING, *values, remedy=ROUTER_REMEDY)
    assert is_no_link(others)


@pytest.mark.parametrize("any_address", ["[::]", "0.0.0.0"])  # noqa: S104 - nothing binds them
def test_the_gateway_is_found_on_the_address_where_it_listens(gateway: str, any_address: str) -> None:
    everywhere = gateway.replace("127.0.0.1", any_address)
    for listen in ([everywhere], [free_endpoint(), everywhere], {"peer": [everywhere], "router": []}):
        link, serving = found(with_endpoints(listen=listen))
        assert is_link_to(link, "0 routers and 1 peer")
        assert is_finding(serving, "zenoh", "gateway", Result.PASSING, "lab")


def test_endpoints_of_other_modes_are_not_used(gateway: str) -> None:
    for keys in (with_endpoints(connect={"client": [gateway]}), zenoh_keys("peer")):
        link, absence = found(keys)
        assert is_link_to(link, "0 routers and 0 peers")
        assert is_no_gateway(absence, "lab")


def test_an_address_that_another_program_uses_fails() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        free = free_endpoint()
        link, *others = found(with_endpoints(listen=[free, taken]))
    remedy = ["`ss -ltnp`", "listen/endpoints", "zenoh.config"]
    assert is_finding(link, "zenoh", "link", Result.FAILING, f"{free}, {taken}", remedy=remedy)
    assert is_no_link(others)


def test_an_address_where_nobody_listens_passes() -> None:
    for listen in (free_endpoint(), "tcp/127.0.0.1:0"):
        link, absence = found(with_endpoints(listen=[listen]))
        assert is_link_to(link, "0 routers and 0 peers")
        assert is_no_gateway(absence, "lab")


LOCAL, REMOTE = "tcp/127.0.0.1:7447", "tcp/192.0.2.1:7447"


@pytest.mark.parametrize(
    ("changes", "leaves"),
    [
        ({}, False),
        ({"scouting": {"multicast": {"enabled": True}}}, True),
        ({"connect": {"endpoints": [LOCAL, REMOTE]}}, True),
        ({"listen": {"endpoints": [REMOTE]}}, True),
        ({"listen": {"endpoints": [REMOTE]}, "mode": "client"}, False),
    ],
)
def test_messages_leave_this_computer_by_any_remote_endpoint_or_by_scouting(
    changes: dict[str, Any], leaves: bool
) -> None:
    config = with_endpoints(connect=[LOCAL], listen=[LOCAL]) | changes
    assert leaves_host(ZenohSettings(config=config)) is leaves
