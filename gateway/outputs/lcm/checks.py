"""The doctor's checks of LCM: the multicast route, who can send requests, and the receive buffer."""

import socket
from collections.abc import Sequence
from typing import Final
from urllib.parse import parse_qs

from gateway.config.settings import SourceSettings
from gateway.errors import OutputError
from gateway.outputs.findings import Check, Finding, MessageLoad
from gateway.outputs.lcm.connection import (
    MULTICAST_SCHEMES,
    multicast_destination,
    multicast_interface,
    multicast_problem,
    open_lcm,
    scheme_of,
    split_url,
)
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.open_ports import Access, OpenPort, control_or

PAUSE_S: Final = 0.02
"""The longest time that a subscriber may pause without losing a message."""

_LARGEST_DATAGRAM: Final = 65_499
"""LCM splits larger messages into several datagrams."""

_FIREWALL: Final = "Install the firewall rule, or {}: docs/how-to/secure.md#lcm-and-ttl0."
"""The remedy for a port; the other choice is filled in."""

_LOOPBACK: Final = {None, "", "127.0.0.1", "::1", "localhost"}

_ROUTE, _REQUESTS, _BUFFERS = Check("lcm", "route"), Check("lcm", "requests"), Check("lcm", "buffers")


def check_lcm(
    settings: LcmSettings, _sources: Sequence[str], loads: Sequence[MessageLoad], _seconds: float
) -> list[Finding]:
    """Check the route, and the default receive buffer of a subscriber to ``loads``."""
    url = settings.effective_url
    scheme = scheme_of(url)
    if scheme not in MULTICAST_SCHEMES:
        route = _ROUTE.passing(f"{url} does not need multicast")
        if scheme == "tcpq":
            try:
                open_lcm(url)
            except OutputError as error:
                problem = str(error).partition("; ")[0]
                route = _ROUTE.failing(problem, "Start LCM's TCP relay, or correct lcm.url.")
        buffers = _BUFFERS.not_tested(f"{scheme} does not need a receive buffer")
        return [route, _check_requests(settings), buffers]
    return [_check_route(url), _check_requests(settings), _check_buffers(url, loads)]


def leaves_host(settings: LcmSettings) -> bool:
    """Return whether messages may leave this computer."""
    url = settings.effective_url
    scheme = scheme_of(url)
    if scheme in MULTICAST_SCHEMES:
        return _ttl(url) != "0"
    return scheme == "tcpq" and split_url(url).hostname not in _LOOPBACK


def open_ports(settings: LcmSettings, sources: Sequence[SourceSettings]) -> list[OpenPort]:
    """Return the multicast groups of messages and of requests, and the ports that the output sends from."""
    url = settings.effective_url
    ports = []
    if destination := multicast_destination(url):
        stays = "messages stay on this computer (ttl=0), but others can send forged ones to it"
        purpose = stays if _ttl(url) == "0" else "everybody receives, and can send forged messages"
        interface, remedy = _interface(url), _FIREWALL.format("switch LCM off")
        ports.append(OpenPort("udp", *destination, Access.PUBLISH, purpose, remedy, interface))
        ports.append(_sent_from("LCM sends messages from here; nothing that arrives is read"))
    url = settings.effective_queries_url
    if settings.queries and (destination := multicast_destination(url)):
        access = control_or(Access.READ, sources)
        remedy = _FIREWALL.format("set lcm.queries to false")
        ports.append(OpenPort("udp", *destination, access, "requests are answered", remedy, _interface(url)))
        ports.append(_sent_from("LCM sends replies from here; nothing that arrives is read"))
    return ports


def _sent_from(purpose: str) -> OpenPort:
    return OpenPort("udp", "0.0.0.0", 0, Access.NOTHING, purpose, "")  # noqa: S104 - not bound here


def _interface(url: str) -> str:
    """Return the network interface on which LCM joins the group of ``url``; "" if there is none now."""
    try:
        return multicast_interface(url) or ""
    except OSError:
        return ""


def _ttl(url: str) -> str:
    return parse_qs(split_url(url).query).get("ttl", ["0"])[0]


def _check_route(url: str) -> Finding:
    problem = multicast_problem(url)
    if problem:
        return _ROUTE.problem(problem)
    try:
        open_lcm(url)
    except OutputError as error:
        return _ROUTE.failing(str(error).partition("; ")[0], "Correct lcm.url.")
    address = split_url(url).netloc or "the default group"
    ttl = _ttl(url)
    if ttl == "0":
        return _ROUTE.passing(f"multicast to {address} works and stays on this computer (ttl=0)")
    return _ROUTE.passing(f"multicast to {address} works, with ttl={ttl}")


def _check_requests(settings: LcmSettings) -> Finding:
    """Check whether other computers can send requests. The ttl of the gateway's URL does not prevent it."""
    if not settings.queries:
        return _REQUESTS.passing("lcm.queries is false: the gateway receives nothing on LCM")
    url = settings.effective_queries_url
    try:
        interface = multicast_interface(url)
    except OSError:
        return _REQUESTS.not_tested("it needs route, which failed")
    if interface is None:
        return _REQUESTS.passing(f"{url} does not use multicast")
    if interface == "lo":
        return _REQUESTS.passing("multicast uses the loopback interface only")
    return _REQUESTS.warning(
        f"the gateway joins multicast on the network interface {interface}; requests from other "
        "computers arrive unless a firewall drops them, also with ttl=0, which limits only sending",
        "On a network that others use, set lcm.queries to false, or install the firewall rule in "
        "docs/how-to/secure.md.",
    )


def _check_buffers(url: str, loads: Sequence[MessageLoad]) -> Finding:
    needed = max(
        sum(load.rate_hz * PAUSE_S * charged_bytes(load.largest_bytes) for load in loads),
        2 * max((charged_bytes(load.largest_bytes) for load in loads), default=0),
    )
    if not needed:
        return _BUFFERS.not_tested("no frames arrived, so the sizes of messages are unknown")
    requested = parse_qs(split_url(url).query).get("recv_buf_size", [""])[0]
    available = receive_buffer_bytes(int(requested) if requested.isdecimal() else None)
    largest = max(load.largest_bytes for load in loads)
    found = (
        f"a subscriber's receive buffer has {_kib(available)}; a pause of {1000 * PAUSE_S:g} ms needs "
        f"{_kib(needed)}, with messages of up to {largest} bytes"
    )
    if available >= needed:
        return _BUFFERS.passing(found)
    size = -(-round(needed) // 2)  # the kernel doubles the size that a program requests
    remedy = f"Add recv_buf_size={size} to the LCM URL of every subscriber"
    if receive_buffer_bytes(2**30) < needed:
        remedy += f", and allow it on their computers: sysctl -w net.core.rmem_max={size}"
    return _BUFFERS.failing(found, f"{remedy}.")


def receive_buffer_bytes(requested: int | None) -> int:
    """Return the buffer size of a UDP socket that requests this size; None requests nothing.

    This is limited by net.core.rmem_default and rmem_max, which a container may not show.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if requested is not None:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, requested)
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def charged_bytes(message_bytes: int) -> int:
    """Return an upper bound of the bytes that a message occupies in a receive buffer.

    Linux counts the memory allocated for a datagram: the next power of two above its size and headers,
    plus 256. Measured on loopback: 1280 for 200 bytes, 2304 for 1500, 16640 for 8000.
    """
    full_datagrams, rest = divmod(message_bytes, _LARGEST_DATAGRAM)
    sizes = [_LARGEST_DATAGRAM] * full_datagrams + ([rest] if rest else [])
    return sum(256 + (1 << (size + 399).bit_length()) for size in sizes)


def _kib(size: float) -> str:
    return f"{size / 1024:.0f} KiB"
