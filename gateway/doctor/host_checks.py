"""Looks at this computer: LCM's way out, socket buffers, and whether the clock is synchronised."""

import ctypes
import socket
from collections.abc import Iterable
from typing import Final
from urllib.parse import parse_qs, urlsplit

from gateway.config.settings import LcmSettings
from gateway.doctor.finding import Finding, Patient
from gateway.doctor.observation import ComponentSeen
from gateway.errors import OutputError
from gateway.outputs.lcm.output import multicast_problem, open_lcm

LCM_CHECKS: Final = ("route", "buffers")

PAUSE_S: Final = 0.02
"""How long LCM's receiving thread may have to wait for a processor without a message being lost."""

_STA_UNSYNC: Final = 0x40  # linux/timex.h
_MULTICAST: Final = ("udpm", "mpudpm")
_LARGEST_DATAGRAM: Final = 65_499
"""LCM cuts larger messages into pieces."""

_lcm: Final = Patient("lcm")
_host: Final = Patient("this computer")


def examine_lcm(settings: LcmSettings, seen: Iterable[ComponentSeen]) -> list[Finding]:
    """Return whether messages leave, and whether a subscriber's socket holds enough of what was seen."""
    if not settings.enabled:
        return [_lcm.untested(check, "lcm.enabled is false") for check in LCM_CHECKS]
    url = settings.effective_url
    scheme = urlsplit(url).scheme
    if scheme not in _MULTICAST:
        return [_other_provider(url, scheme), _lcm.untested("buffers", f"{scheme} needs none")]
    return [_route(url), _buffers(url, list(seen))]


def _other_provider(url: str, scheme: str) -> Finding:
    if scheme == "tcpq":
        try:
            open_lcm(url)
        except OutputError as error:
            return _lcm.bad(
                "route", str(error).partition("; ")[0], "Start LCM's TCP relay, or correct lcm.url."
            )
    return _lcm.good("route", f"{url} needs no multicast")


def _route(url: str) -> Finding:
    problem = multicast_problem(url)
    if problem:
        found, _, remedy = problem.partition("; ")
        return _lcm.bad("route", found, f"{remedy[:1].upper()}{remedy[1:]}.")
    try:
        open_lcm(url)
    except OutputError as error:
        return _lcm.bad("route", str(error).partition("; ")[0], "Correct lcm.url.")
    ttl = parse_qs(urlsplit(url).query).get("ttl", ["0"])[0]
    reach = "which stays on this computer (ttl=0)" if ttl == "0" else f"with ttl={ttl}"
    return _lcm.good("route", f"multicast goes out to {urlsplit(url).netloc or 'the default group'}, {reach}")


def _buffers(url: str, seen: list[ComponentSeen]) -> Finding:
    needed = max(
        sum(component.rate_hz * PAUSE_S * charged_bytes(component.message_bytes) for component in seen),
        2 * max((charged_bytes(component.message_bytes) for component in seen), default=0),
    )
    if not needed:
        return _lcm.untested("buffers", "no frames came, so the messages' sizes are not known")
    asked = parse_qs(urlsplit(url).query).get("recv_buf_size", [""])[0]
    has = receive_buffer_bytes(int(asked) if asked.isdecimal() else None)
    largest = max(component.message_bytes for component in seen)
    found = (
        f"a subscriber's socket holds {_kib(has)}; messages of at most {largest} bytes need {_kib(needed)} "
        f"for a pause of {1000 * PAUSE_S:g} ms"
    )
    if has >= needed:
        return _lcm.good("buffers", found)
    size = -(-round(needed) // 2)  # the kernel doubles what a program asks for
    remedy = f"Add recv_buf_size={size} to the LCM URL of every subscriber"
    if receive_buffer_bytes(2**30) < needed:
        remedy += f", and allow it on their computers: sysctl -w net.core.rmem_max={size}"
    return _lcm.bad("buffers", found, f"{remedy}.")


def receive_buffer_bytes(asked: int | None) -> int:
    """Return what the kernel gives a UDP socket that asks for so much; None asks for nothing.

    net.core.rmem_default and rmem_max, asked of the kernel itself: a container may not show them.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if asked is not None:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, asked)
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def charged_bytes(message_bytes: int) -> int:
    """Return what a message costs of a receive buffer, at most.

    Linux counts the memory that it takes for a datagram: the next power of two above its size and
    headers, and 256. Measured on loopback: 1280 for 200 bytes, 2304 for 1500, 16640 for 8000.
    """
    pieces, rest = divmod(message_bytes, _LARGEST_DATAGRAM)
    sizes = [_LARGEST_DATAGRAM] * pieces + ([rest] if rest else [])
    return sum(256 + (1 << (size + 399).bit_length()) for size in sizes)


def _kib(size: float) -> str:
    return f"{size / 1024:.0f} KiB"


class _Timex(ctypes.Structure):
    """The begin of Linux's struct timex, and room for the rest of it."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def read_clock() -> tuple[bool, int]:
    """Return whether the kernel's clock is synchronised, and by how many µs at most it is off.

    Raises OSError where the kernel does not say, as in some containers.
    """
    timex = _Timex()  # modes 0: nothing is changed
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "adjtimex"):
        raise OSError("this system has no adjtimex")
    if libc.adjtimex(ctypes.byref(timex)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex is not allowed")
    return not timex.status & _STA_UNSYNC, timex.maxerror


def examine_clock() -> Finding:
    """Return whether this computer's clock is synchronised: utime and capture_utime are by it."""
    try:
        synchronised, off_us = read_clock()
    except OSError as error:
        return _host.untested("clock", f"the kernel does not say: {error.strerror or error}")
    if synchronised:
        return _host.good("clock", f"synchronised, off by at most {off_us / 1000:.1f} ms")
    return _host.bad(
        "clock",
        "this computer's clock is not synchronised, so times of other computers do not compare with utime",
        "Set up chrony or systemd-timesyncd against the lab's time server (`chronyc tracking` or "
        "`timedatectl` shows it); in a container, on its host.",
    )
