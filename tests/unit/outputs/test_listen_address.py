import socket

import pytest

from gateway.outputs.listen_address import from_this_computer, host_in_url, is_loopback, listen_problem
from tests.networks import free_port

ALL_IPV4 = "0.0.0.0"  # noqa: S104 - not bound


def test_who_can_reach_an_address() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.1.2.3", "::1", "localhost")))
    assert not any(map(is_loopback, ("192.0.2.1", "lab-pc", "::", ALL_IPV4)))


@pytest.mark.parametrize(
    ("listens_on", "address", "in_url"),
    [
        (ALL_IPV4, "127.0.0.1", "127.0.0.1"),
        ("::", "::1", "[::1]"),
        ("192.0.2.1", "192.0.2.1", "192.0.2.1"),
        ("lab-pc", "lab-pc", "lab-pc"),
    ],
)
def test_how_to_connect_from_this_computer(listens_on: str, address: str, in_url: str) -> None:
    assert from_this_computer(listens_on) == address
    assert host_in_url(address) == in_url


def only_ipv6(host: str, port: int, **_: object) -> list[tuple[object, ...]]:
    """Resolve a name as on a computer on which it has only an address of IPv6."""
    assert host == "ip6-localhost"
    return [(socket.AF_INET6, socket.SOCK_STREAM, socket.IPPROTO_TCP, "", ("::1", port, 0, 0))]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "::", ALL_IPV4])
def test_a_free_port_can_be_used(host: str) -> None:
    assert listen_problem(host, free_port()) == ""


def test_a_name_of_an_ipv6_address_can_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", only_ipv6)
    assert listen_problem("ip6-localhost", free_port()) == ""
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as other:
        assert listen_problem("ip6-localhost", other.getsockname()[1]) == "Address already in use"


def test_why_no_server_can_listen() -> None:
    assert listen_problem("192.0.2.1", free_port()) == "Cannot assign requested address"
    assert listen_problem("no-such-name.invalid", free_port()) not in {"", "Unknown error -2"}
