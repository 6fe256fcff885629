"""Who can reach a port, which ports are in use, and the ports of each output by its settings."""

import os
import socket
from typing import Any, Final

import pytest

from gateway.config.settings import SourceSettings
from gateway.outputs.foxglove.settings import FoxgloveSettings
from gateway.outputs.open_ports import (
    Access,
    OpenPort,
    Reach,
    interface_names,
    listening_ports,
    ports_in_use,
    reach_of,
)
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.needs import need
from tests.support.networks import free_port

ALL_IPV4: Final = "0.0.0.0"  # noqa: S104 - not bound
INTERFACES: Final = {"127.0.0.1": "lo", "192.0.2.5": "eth0", "2001:db8::5": "eth0", "198.51.100.7": "wlan0"}
LAB: Final = SourceSettings(name="lab", host="192.0.2.20")
CONTROLLED: Final = LAB.model_copy(update={"remote_control": True})


def reached(host: str, interface: str = "") -> tuple[Reach, str]:
    return reach_of(OpenPort("tcp", host, 1, Access.READ, "", "", interface), INTERFACES)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_a_port_on_loopback_is_for_this_computer_only(host: str) -> None:
    assert reached(host) == (Reach.THIS_COMPUTER, "only this computer")


def test_other_addresses_are_reached_from_the_networks_of_their_interfaces() -> None:
    """A doctor that says "only this computer" of one of these is worse than none."""
    every = (Reach.EVERY_NETWORK, "every network of this computer (eth0, wlan0)")
    assert [reached(host) for host in (ALL_IPV4, "::")] == [every, every]
    assert reached("198.51.100.7") == (Reach.ONE_NETWORK, "the network of wlan0")
    assert reached("2001:db8::5") == (Reach.ONE_NETWORK, "the network of eth0")
    reach, text = reached("203.0.113.1")
    assert (reach, "does not have" in text) == (Reach.ONE_NETWORK, True)
    reach, text = reached("no-such-name.invalid")
    assert (reach, "cannot be resolved" in text) == (Reach.EVERY_NETWORK, True)


def test_a_name_counts_as_reachable_if_one_of_its_addresses_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the name of this computer, which /etc/hosts often has at a loopback address, too."""
    found = [
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in ("127.0.1.1", "192.0.2.5")
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert reached("lab-pc") == (Reach.ONE_NETWORK, "the network of eth0")


def test_a_multicast_group_is_reached_where_it_is_joined() -> None:
    group = "239.255.76.67"
    assert reached(group)[0] is Reach.EVERY_NETWORK
    assert reached(group, "eth0") == (Reach.ONE_NETWORK, "the network of eth0")
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
    need(os.path.exists("/proc/net/tcp6") and "::1" in interface_names(), "needs IPv6 on lo")  # noqa: PTH110
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as server:
        assert ("tcp", server.getsockname()[1]) in ports_in_use()


def test_an_output_that_describes_no_ports_is_listed_by_its_settings() -> None:
    [port] = listening_ports(FoxgloveSettings(host=ALL_IPV4, port=8765), [LAB])
    assert port[:4] == ("tcp", ALL_IPV4, 8765, Access.READ)


def opened(output: str, sources: list[SourceSettings], **keys: Any) -> list[tuple[str, str, int, Access]]:
    """Return the beginnings of an output's ports."""
    kind = OUTPUTS[output]
    return [port[:4] for port in kind.open_ports(kind.settings(**keys), sources)]


def test_each_output_lists_its_ports_and_only_remote_control_gives_control() -> None:
    """``remote_control`` of one source gives no control on the port of another."""
    other = SourceSettings(name="hall", host="192.0.2.21")
    assert opened("rtc3d", [CONTROLLED, other], ports={"lab": 1, "hall": 2}) == [
        ("tcp", "127.0.0.1", 1, Access.CONTROL),
        ("tcp", "127.0.0.1", 2, Access.READ),
    ]
    assert opened("vrpn", [CONTROLLED], host=ALL_IPV4) == [
        ("tcp", ALL_IPV4, 3883, Access.READ),
        ("udp", ALL_IPV4, 3883, Access.READ),
    ]
    assert opened("foxglove", [CONTROLLED], host="::") == [("tcp", "::", 8765, Access.READ)]
    assert opened("lsl", [LAB])[0] == ("udp", "::", 16571, Access.READ)
    assert opened("takes", [CONTROLLED]) == opened("ros2", [CONTROLLED]) == []


LCM_GROUP: Final = "239.255.76.67"


def test_lcm_lists_where_it_sends_and_where_requests_arrive() -> None:
    sending = [("udp", LCM_GROUP, 7667, Access.PUBLISH), ("udp", ALL_IPV4, 0, Access.NOTHING)]
    url = f"udpm://{LCM_GROUP}:7667?ttl=0"
    assert opened("lcm", [LAB], url=url) == [*sending, ("udp", LCM_GROUP, 7668, Access.READ)]
    assert opened("lcm", [LAB, CONTROLLED], url=url)[-1] == ("udp", LCM_GROUP, 7668, Access.CONTROL)
    assert opened("lcm", [CONTROLLED], url=url, queries=False) == sending
    assert opened("lcm", [CONTROLLED], url="tcpq://192.0.2.1:7700") == []


def zenoh_ports(**config: Any) -> list[tuple[str, str, int, str, str]]:
    """Return where Zenoh's ports are and what protects them; scouting is off unless ``config`` has it."""
    config = {"scouting": {"multicast": {"enabled": False}}} | config
    ports = OUTPUTS["zenoh"].open_ports(ZenohSettings(config=config), [LAB])
    return [(port.protocol, port.host, port.port, port.encryption, port.authentication) for port in ports]


def test_zenoh_lists_its_endpoints_with_what_they_ask_of_those_who_connect() -> None:
    endpoints = [
        "tcp/[::]:7447",
        "tls/192.0.2.5:7448",
        "quic/0.0.0.0:7449#iface=eth0",
        "unixsock-stream//run/z",
    ]
    listen = {"listen": {"endpoints": endpoints}}
    assert zenoh_ports(**listen) == [
        ("tcp", "::", 7447, "", ""),
        ("tcp", "192.0.2.5", 7448, "TLS", ""),  # encrypted, but for everybody
        ("udp", ALL_IPV4, 7449, "TLS", ""),
    ]
    tls = {"link": {"tls": {"enable_mtls": True}}}
    password = {"auth": {"usrpwd": {"dictionary_file": "/etc/zenohd/users"}}}
    assert [port[3:] for port in zenoh_ports(**listen, transport=tls)] == [
        ("", ""),
        ("TLS", "client certificates"),
        ("TLS", "client certificates"),
    ]
    assert [port[3:] for port in zenoh_ports(**listen, transport=tls | password)] == [
        ("", "password"),
        ("TLS", "client certificates and password"),
        ("TLS", "client certificates and password"),
    ]
    assert zenoh_ports() == [("tcp", "::", 0, "", "")]
    assert zenoh_ports(mode="router") == [("tcp", "::", 7447, "", "")]
    assert zenoh_ports(mode="client", **listen) == []


def test_zenoh_lists_the_ports_of_scouting_which_a_password_does_not_protect() -> None:
    """Zenoh asks only those for a password who connect to it, not those that it finds."""
    nobody: dict[str, Any] = {"listen": {"endpoints": []}}
    found, answers = ("udp", "224.0.0.224", 7446), ("udp", ALL_IPV4, 0)
    on: dict[str, Any] = {"scouting": {"multicast": {}}}
    password = {"auth": {"usrpwd": {"dictionary_file": "/etc/zenohd/users"}}}
    assert zenoh_ports(**nobody, **on, transport=password) == [(*found, "", ""), (*answers, "", "")]
    only_tls = {"link": {"protocols": ["tls"], "tls": {"enable_mtls": True}}}
    certificates = ("TLS", "client certificates")
    assert zenoh_ports(**nobody, **on, transport=only_tls) == [
        (*found, *certificates),
        (*answers, *certificates),
    ]
    other = {"scouting": {"multicast": {"address": "224.0.0.225:7000", "interface": "eth0"}}}
    assert zenoh_ports(**nobody, **other)[0] == ("udp", "224.0.0.225", 7000, "", "")
    assert zenoh_ports(mode="client", **on) == [(*answers, "", "")]
    assert zenoh_ports(mode="client", **on, connect={"endpoints": ["tcp/192.0.2.10:7447"]}) == []
