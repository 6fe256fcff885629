"""The ports that the gateway opens: who can reach them, and what they can do there."""

import array
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

from gateway.config.settings import SourceSettings


class Access(StrEnum):
    """What peers can do at a port; each value includes those before it. They appear in the doctor's JSON."""

    NOTHING = "nothing"
    READ = "read"
    PUBLISH = "publish"
    """Send messages that subscribers take for the gateway's."""

    CONTROL = "control"
    """Start and stop recordings and takes."""


class OpenPort(NamedTuple):
    """A TCP or UDP port that the gateway opens, or a multicast group to which it sends.

    ``host`` is the address or name on which it listens, or the multicast group. ``port`` is 0 if the system
    chooses one at each start. ``purpose`` says what peers find there. ``remedy`` is a sentence that says how
    to keep others out. ``interface`` is where the multicast group is joined; "" means on any. ``encryption``
    and ``authentication`` name what protects the port; "" means nothing does.
    """

    protocol: str
    host: str
    port: int
    access: Access
    purpose: str
    remedy: str
    interface: str = ""
    encryption: str = ""
    authentication: str = ""


FIREWALL: Final = (
    "Open the port in the firewall only for the computers that need it: "
    "docs/how-to/secure.md#ports-without-a-password."
)
"""The remedy for a port whose protocol has no passwords."""


def control_or(access: Access, sources: Collection[SourceSettings]) -> Access:
    """Return CONTROL if peers may control one of the sources, else ``access``."""
    return Access.CONTROL if any(source.remote_control for source in sources) else access


def web_port(host: str, port: int, purpose: str, setting: str) -> OpenPort:
    """Return a port that nginx can protect; ``setting`` names the one that has its host."""
    remedy = (
        f"Leave {setting} at 127.0.0.1, and put nginx with TLS and a password in front: "
        "docs/how-to/secure.md#tls-and-a-password."
    )
    return OpenPort("tcp", host, port, Access.READ, purpose, remedy)


def listening_ports(settings: Any, _sources: Sequence[SourceSettings]) -> list[OpenPort]:
    """Return the TCP ports of an output that does not describe its ports."""
    return [
        OpenPort(
            "tcp",
            address.host,
            address.port,
            Access.READ,
            "clients of this output; it does not describe what they can do",
            FIREWALL,
        )
        for address in settings.listens_on
    ]


class Reach(StrEnum):
    """From where a port can be reached, unless a firewall prevents it. The values appear in the JSON."""

    THIS_COMPUTER = "this computer"
    ONE_NETWORK = "one network"
    EVERY_NETWORK = "every network"


def reach_of(port: OpenPort, interfaces: Mapping[str, str]) -> tuple[Reach, str]:
    """Return who can reach a port, also as text. ``interfaces`` has the names by address.

    Blocks while a host name is looked up. A name that cannot be resolved counts as reachable.
    """
    others = list(dict.fromkeys(name for name in interfaces.values() if name != "lo"))
    names = ", ".join(others) or "it has none now"
    every = Reach.EVERY_NETWORK, f"every network of this computer ({names})"
    try:
        found = socket.getaddrinfo(port.host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        return Reach.EVERY_NETWORK, f"unknown, because the name {port.host} cannot be resolved"
    addresses = [ipaddress.ip_address(str(address[0]).partition("%")[0]) for *_, address in found]
    if any(address.is_multicast for address in addresses):
        name = port.interface
    elif all(address.is_loopback for address in addresses):
        name = "lo"
    elif any(address.is_unspecified for address in addresses):
        return every
    else:
        known = [interfaces.get(str(address), "") for address in addresses if not address.is_loopback]
        name = known[0] or "a network interface that this computer does not have now"
    if name == "lo":
        return Reach.THIS_COMPUTER, "only this computer"
    return (Reach.ONE_NETWORK, f"the network of {name}") if name else every


# What the kernel says -----------------------------------------------------------------------

_SIOCGIFCONF: Final = 0x8912
_IFCONF: Final = struct.Struct("iP")
_IFREQ: Final = struct.Struct("16s4x4s16x")
"""The structures of netdevice(7), for addresses of IPv4."""

_MAX_ADDRESSES: Final = 256
_IPV6_ADDRESSES: Final = Path("/proc/net/if_inet6")


def interface_names() -> dict[str, str]:
    """Return the names of this computer's network interfaces, by their addresses of IPv4 and IPv6."""
    names = {}
    buffer = array.array("B", bytes(_IFREQ.size * _MAX_ADDRESSES))
    request = _IFCONF.pack(len(buffer), buffer.buffer_info()[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        num_bytes, _ = _IFCONF.unpack(fcntl.ioctl(probe, _SIOCGIFCONF, request))
    for name, address in _IFREQ.iter_unpack(buffer.tobytes()[:num_bytes]):
        names[socket.inet_ntoa(address)] = name.partition(b"\0")[0].decode(errors="replace")
    for line in _lines(_IPV6_ADDRESSES):
        address, *_, name = line.split()
        names[str(ipaddress.IPv6Address(bytes.fromhex(address)))] = name
    return names


_TCP_LISTEN: Final = "0A"
_KERNEL_TABLES: Final = Path("/proc/net")


def ports_in_use(tables: Path = _KERNEL_TABLES) -> set[tuple[str, int]]:
    """Return protocol and number of each port on which a program of this computer listens."""
    used = set()
    for name in ("tcp", "tcp6", "udp", "udp6"):
        for line in list(_lines(tables / name))[1:]:
            _, local, _, state, *_ = line.split()
            if name.startswith("udp") or state == _TCP_LISTEN:
                used.add((name[:3], int(local.rpartition(":")[2], 16)))
    return used


def _lines(file: Path) -> Iterator[str]:
    """Yield the lines of a table of the kernel; none if it has no such table, as without IPv6."""
    try:
        yield from file.read_text().splitlines()
    except OSError:
        return
