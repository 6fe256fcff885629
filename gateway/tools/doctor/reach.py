"""Who can reach a port: the addresses of this computer's network interfaces, and which ports are open now."""

import array
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Final

from gateway.outputs.open_ports import OpenPort


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
_TABLES: Final = Path("/proc/net")


def ports_in_use() -> set[tuple[str, int]]:
    """Return protocol and number of each port on which a program of this computer listens."""
    used = set()
    for name in ("tcp", "tcp6", "udp", "udp6"):
        for line in list(_lines(_TABLES / name))[1:]:
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
