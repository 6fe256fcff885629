"""The doctor's findings about Zenoh, word for word, with real sessions."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from gateway.outputs.findings import Finding, Result
from gateway.outputs.zenoh.checks import check_zenoh, leaves_host
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.networks import free_endpoint, free_port, open_zenoh, zenoh_keys

ROUTER_REMEDY = (
    "Start zenohd at that address, or correct connect/endpoints in zenoh.config. With TLS, check that all "
    "certificates come from one authority, have not expired and contain the address."
)
NO_LINK = [
    Finding("zenoh", check, Result.NOT_TESTED, "it needs link, which failed")
    for check in ("routers", "gateway")
]


def found(config: dict[str, Any], *sources: str, prefix: str = "mocap") -> list[Finding]:
    settings = ZenohSettings.model_construct(config=config, prefix=prefix)
    return check_zenoh(settings, sources or ("lab",), (), 0.2)


def link_passing(text: str) -> Finding:
    return Finding("zenoh", "link", Result.PASSING, f"the session is open and connected to {text}")


def no_gateway(*sources: str) -> Finding:
    text = f"found no gateway that serves {', '.join(sources)}; if one is running, check its zenoh.prefix"
    return Finding("zenoh", "gateway", Result.NOT_TESTED, text)


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
    assert (link.subject, link.check, link.result) == ("zenoh", "link", Result.FAILING)
    assert link.found.startswith("Zenoh does not accept the inline zenoh.config: unknown variant `clinet`")
    assert link.remedy == "Correct zenoh.config."
    assert others == NO_LINK


def test_a_client_whose_router_does_not_run_fails() -> None:
    endpoint = free_endpoint()
    link, *others = found(zenoh_keys("client", connect=endpoint))
    assert link.found.startswith(f"the session does not open: Unable to connect to any of [{endpoint}]")
    assert (link.result, link.remedy) == (Result.FAILING, ROUTER_REMEDY)
    assert others == NO_LINK


def test_a_client_is_connected_to_a_router() -> None:
    endpoint = free_endpoint()
    with session("router", listen=endpoint):
        link, routers, gateway = found(zenoh_keys("client", connect=endpoint))
    assert link == link_passing("a router")
    assert routers.found == f"{endpoint} does not describe itself, so what is behind it is not known"
    assert (
        gateway.found
        == f"found no gateway that serves lab behind {endpoint}, whose access control may hide it"
    )


def test_routers_and_peers_are_counted(gateway: str) -> None:
    endpoints = [gateway, free_endpoint(), free_endpoint(), free_endpoint()]
    with session("peer", listen=endpoints[1]), session("router", listen=endpoints[2]):
        link, *_ = found(with_endpoints(connect=endpoints[:3]), "cave")
        assert link == link_passing("1 router and 2 peers")
        with session("router", listen=endpoints[3]):
            link, *_ = found(with_endpoints(connect=endpoints[2:]), "cave")
            assert link == link_passing("2 routers and 0 peers")


def test_every_source_must_be_served(gateway: str) -> None:
    keys = zenoh_keys("peer", connect=gateway)
    assert found(keys, "lab", "hall")[1] == Finding(
        "zenoh", "gateway", Result.PASSING, "a gateway serves lab, hall"
    )
    assert found(keys, "lab", "cave", "attic")[1] == no_gateway("cave", "attic")
    assert found(keys, "lab", prefix="site")[1] == no_gateway("lab")


def test_a_peer_that_reaches_nobody_fails_with_all_endpoints_and_without_secrets() -> None:
    first, second = free_endpoint(), f"tcp/127.0.0.1:{free_port()}#iface=lo"
    link, *others = found(with_endpoints(connect=[first, second]))
    assert link == Finding(
        "zenoh",
        "link",
        Result.FAILING,
        f"no router or peer can be reached at {first}, {second}, so no data leaves this computer",
        ROUTER_REMEDY,
    )
    assert others == NO_LINK


@pytest.mark.parametrize("any_address", ["[::]", "0.0.0.0"])  # noqa: S104 - nothing binds them
def test_the_gateway_is_found_on_the_address_where_it_listens(gateway: str, any_address: str) -> None:
    everywhere = gateway.replace("127.0.0.1", any_address)
    for listen in ([everywhere], [free_endpoint(), everywhere], {"peer": [everywhere], "router": []}):
        assert found(with_endpoints(listen=listen)) == [
            link_passing("0 routers and 1 peer"),
            Finding("zenoh", "gateway", Result.PASSING, "a gateway serves lab"),
        ]


def test_endpoints_of_other_modes_are_not_used(gateway: str) -> None:
    alone = [link_passing("0 routers and 0 peers"), no_gateway("lab")]
    assert found(with_endpoints(connect={"client": [gateway]})) == alone
    assert found(zenoh_keys("peer")) == alone


def test_an_address_that_another_program_uses_fails() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        free = free_endpoint()
        link, *others = found(with_endpoints(listen=[free, taken]))
    assert link.found.startswith(f"a gateway cannot listen on {free}, {taken}: ")
    assert (link.result, link.remedy) == (
        Result.FAILING,
        "Another program uses the address; `ss -ltnp` shows which one. Stop it, or change listen/endpoints "
        "in zenoh.config.",
    )
    assert others == NO_LINK


def test_an_address_where_nobody_listens_passes() -> None:
    for listen in (free_endpoint(), "tcp/127.0.0.1:0"):
        assert found(with_endpoints(listen=[listen])) == [
            link_passing("0 routers and 0 peers"),
            no_gateway("lab"),
        ]


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
