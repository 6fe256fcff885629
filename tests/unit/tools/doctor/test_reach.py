"""Who can reach a port, and which ports are in use."""

import socket
from typing import Final

import pytest

from gateway.outputs.open_ports import Access, OpenPort
from gateway.tools.doctor.reach import Reach, interface_names, ports_in_use, reach_of
from tests.support.errors import names
from tests.support.needs import need_ipv6
from tests.support.networks import free_port

ALL_IPV4: Final = "0.0.0.0"  # noqa: S104 - not bound
INTERFACES: Final = {"127.0.0.1": "lo", "192.0.2.5": "eth0", "2001:db8::5": "eth0", "198.51.100.7": "wlan0"}


def reached(host: str, interface: str = "") -> tuple[Reach, str]:
    return reach_of(OpenPort("tcp", host, 1, Access.READ, "", "", interface), INTERFACES)


def is_network(found: tuple[Reach, str], interface: str) -> bool:
    return found[0] is Reach.ONE_NETWORK and names(found[1], interface)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_a_port_on_loopback_is_for_this_computer_only(host: str) -> None:
    assert reached(host)[0] is Reach.THIS_COMPUTER


def test_other_addresses_are_reached_from_the_networks_of_their_interfaces() -> None:
    """A doctor that says "only this computer" of one of these is worse than none."""
    every = (Reach.EVERY_NETWORK, "every network of this computer (eth0, wlan0)")
    assert [reached(host) for host in (ALL_IPV4, "::")] == [every, every]
    assert is_network(reached("198.51.100.7"), "wlan0")
    assert is_network(reached("2001:db8::5"), "eth0")
    assert reached("203.0.113.1")[0] is Reach.ONE_NETWORK
    assert reached("no-such-name.invalid")[0] is Reach.EVERY_NETWORK


def test_a_name_counts_as_reachable_if_one_of_its_addresses_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the name of this computer, which /etc/hosts often has at a loopback address, too."""
    found = [
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in ("127.0.1.1", "192.0.2.5")
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert is_network(reached("lab-pc"), "eth0")


def test_a_multicast_group_is_reached_where_it_is_joined() -> None:
    group = "239.255.76.67"
    assert reached(group)[0] is Reach.EVERY_NETWORK
    assert is_network(reached(group, "eth0"), "eth0")
    assert reached(group, "lo")[0] is Reach.THIS_COMPUTER


def test_interfaces_are_named_by_their_addresses() -> None:
    assert interface_names()["127.0.0.1"] == "lo"


def test_the_kernel_says_which_ports_are_in_use() -> None:
    """A connection of a client, which is bound to a port as well, is no open port."""
    with (
        socket.create_server(("127.0.0.1", free_port())) as tcp,
        socket.create_connection(tcp.getsockname()) as client,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
    ):
        udp.bind(("127.0.0.1", free_port()))
        used = ports_in_use()
        assert {("tcp", tcp.getsockname()[1]), ("udp", udp.getsockname()[1])} <= used
        assert ("tcp", client.getsockname()[1]) not in used
        assert ("udp", tcp.getsockname()[1]) not in used


def test_ports_of_ipv6_are_in_use_too() -> None:
    need_ipv6()
    assert "::1" in interface_names()
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as server:
        assert ("tcp", server.getsockname()[1]) in ports_in_use()
