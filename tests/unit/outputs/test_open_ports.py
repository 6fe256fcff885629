"""The ports of each output by its settings."""

from typing import Any, Final

import pytest

from gateway.config.settings import SourceSettings
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.open_ports import Access, listening_ports
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.config import zenoh_config
from gateway.outputs.zenoh.open_ports import is_open_to_others
from gateway.outputs.zenoh.settings import ZenohSettings

ALL_IPV4: Final = "0.0.0.0"  # noqa: S104 - not bound
LAB: Final = SourceSettings(name="lab", host="192.0.2.20")
CONTROLLED: Final = LAB.model_copy(update={"remote_control": True})


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


LOCAL: Final = {
    "scouting": {"multicast": {"enabled": False}},
    "listen": {"endpoints": ["tcp/127.0.0.1:7447"]},
}
LCM_GROUP: Final = "239.255.76.67"


def test_lcm_lists_where_it_sends_and_where_requests_arrive() -> None:
    sent_from = ("udp", ALL_IPV4, 0, Access.NOTHING)
    sending = [("udp", LCM_GROUP, 7667, Access.PUBLISH), sent_from]
    url = f"udpm://{LCM_GROUP}:7667?ttl=0"
    assert opened("lcm", [LAB], url=url) == [*sending, ("udp", LCM_GROUP, 7668, Access.READ), sent_from]
    assert opened("lcm", [LAB, CONTROLLED], url=url)[2] == ("udp", LCM_GROUP, 7668, Access.CONTROL)
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


@pytest.mark.parametrize(
    ("config", "is_open"),
    [
        ({}, True),
        ({"scouting": {"multicast": {"enabled": False}}}, True),
        (LOCAL, False),
        (LOCAL | {"listen": {"endpoints": ["tcp/0.0.0.0:7447"]}}, True),
        (LOCAL | {"scouting": {"multicast": {"enabled": True}}}, True),
        ({"mode": "client", "connect": {"endpoints": ["tcp/192.0.2.9:7447"]}}, False),
    ],
)
def test_whether_zenoh_is_open_to_other_computers_without_a_password(
    config: dict[str, Any], *, is_open: bool
) -> None:
    """The gateway logs it at its start: by default, it is."""
    assert is_open_to_others(zenoh_config(config)) is is_open
