import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.outputs import listen_address
from gateway.outputs.listen_address import (
    foreign_request,
    from_this_computer,
    host_in_url,
    is_loopback,
    listen_problem,
)
from tests.support.networks import free_port

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
    return [(socket.AF_INET6, socket.SOCK_STREAM, socket.IPPROTO_TCP, "", ("::", port, 0, 0))]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::", ALL_IPV4])
def test_a_free_port_can_be_used(host: str) -> None:
    assert listen_problem(host, free_port()) == ""


def test_a_name_of_an_ipv6_address_can_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", only_ipv6)
    assert listen_problem("ip6-localhost", free_port()) == ""
    with socket.create_server(("::", 0), family=socket.AF_INET6) as other:
        assert listen_problem("ip6-localhost", other.getsockname()[1]) == "Address already in use"


def test_why_no_server_can_listen() -> None:
    assert listen_problem("192.0.2.1", free_port()) == "Cannot assign requested address"
    assert listen_problem("no-such-name.invalid", free_port()) not in {"", "Unknown error -2"}


@pytest.fixture
def _lab_pc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Let this computer be lab-pc in the domain example.org."""
    (tmp_path / "resolv.conf").write_text("# by hand\nnameserver 192.0.2.53\n\nsearch Example.org\n")
    monkeypatch.setattr(listen_address, "_RESOLVER", tmp_path / "resolv.conf")
    monkeypatch.setattr(socket, "gethostname", lambda: "Lab-PC")
    listen_address._own_names.cache_clear()
    yield
    listen_address._own_names.cache_clear()


LOOPBACK = ("localhost", "LOCALHOST:8080", "view.localhost", "127.0.0.1:8080", "[::1]:8080", "localhost.:1")
OWN_NAMES = ("lab-pc:8080", "Lab-PC.example.org", "lab-pc.local.")
ADDRESSES = ("192.0.2.5:8080", "[2001:db8::5]")
FOREIGN = (
    *("evil.example", "localhost.evil.example:8080", "127.0.0.1.evil.example", "lab-pc.evil.example"),
    *("user@localhost", "localhost:8080:1", "[::1", "[localhost]", "evil.example/localhost", ""),
)


@pytest.mark.usefixtures("_lab_pc")
@pytest.mark.parametrize(
    ("listens_on", "own", "foreign"),
    [
        ("127.0.0.1", LOOPBACK, (*OWN_NAMES, *ADDRESSES, *FOREIGN)),
        ("localhost", LOOPBACK, (*OWN_NAMES, *ADDRESSES, *FOREIGN)),
        (ALL_IPV4, (*LOOPBACK, *OWN_NAMES, *ADDRESSES), FOREIGN),
        ("::", (*LOOPBACK, *OWN_NAMES, *ADDRESSES), FOREIGN),
        ("192.0.2.5", (*LOOPBACK, *OWN_NAMES, *ADDRESSES), FOREIGN),
        ("view.example.net", ("view.example.net", *OWN_NAMES, *ADDRESSES), FOREIGN),
    ],
)
def test_which_hosts_a_request_may_name(
    listens_on: str, own: tuple[str, ...], foreign: tuple[str, ...]
) -> None:
    """A foreign site's name that leads to this computer (DNS rebinding) is refused, with the reason."""
    assert [host for host in own if foreign_request(listens_on, [host], [])] == []
    for host in foreign:
        assert f"'{host}' is not a name or address of this server" in foreign_request(listens_on, [host], [])


@pytest.mark.parametrize(
    ("hosts", "origins", "is_foreign"),
    [
        ([], [], False),  # HTTP/1.0; no browser
        (["127.0.0.1:8080"], ["http://127.0.0.1:8080"], False),
        (["127.0.0.1:8080"], ["http://localhost:8080"], False),
        (["localhost"], ["https://localhost"], False),
        (["127.0.0.1:8080"], ["http://127.0.0.1:9000"], True),
        (["127.0.0.1:8080"], ["http://evil.example:8080"], True),
        ([], ["http://evil.example"], True),
        (["127.0.0.1:8080"], ["null"], True),
        (["127.0.0.1:8080"], ["file://"], True),
        (["127.0.0.1:8080", "evil.example"], [], True),
        (["127.0.0.1:8080"], ["http://127.0.0.1:8080", "http://evil.example"], True),
    ],
)
def test_pages_of_other_sites_are_refused(hosts: list[str], origins: list[str], is_foreign: bool) -> None:
    assert bool(foreign_request("127.0.0.1", hosts, origins)) == is_foreign
