"""Checks of this computer: its clock, and the receive buffer of its kernel."""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gateway.outputs.findings import Finding, Subject

_STA_UNSYNC: Final = 0x40  # linux/timex.h

_computer: Final = Subject("this computer")


class _Timex(ctypes.Structure):
    """The first fields of Linux's struct timex, and space for the rest."""

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
    """Return whether the kernel's clock is synchronised, and its maximum error in µs.

    Raises OSError if the kernel does not report it, as in some containers.
    """
    timex = _Timex()  # modes is 0, so adjtimex changes nothing
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "adjtimex"):
        raise OSError("this system has no adjtimex")
    if libc.adjtimex(ctypes.byref(timex)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex is not allowed")
    return not timex.status & _STA_UNSYNC, timex.maxerror


def check_clock(leaving: Sequence[str]) -> Finding:
    """Check that this computer's clock is synchronised.

    ``leaving`` names the outputs whose messages leave this computer. Without any, an unsynchronised clock is
    a warning: programs on this computer use the same clock.
    """
    try:
        is_synchronised, max_error_us = read_clock()
    except OSError as error:
        return _computer.not_tested("clock", f"the kernel does not report it: {error.strerror or error}")
    if is_synchronised:
        return _computer.passing(
            "clock", f"synchronised, with an error of at most {max_error_us / 1000:.1f} ms"
        )
    found = (
        "this computer's clock is not synchronised, so utime cannot be compared with the clocks of other "
        "computers"
    )
    remedy = (
        "Set up chrony or systemd-timesyncd with the lab's time server; `chronyc tracking` or `timedatectl` "
        "shows the state. In a container, do this on the host."
    )
    if leaving:
        return _computer.failing("clock", f"{found}, which {' and '.join(leaving)} can reach", remedy)
    return _computer.warning("clock", f"{found}; so far, all messages stay on this computer", remedy)


CHECK: Final = "buffer"
_TCP_RMEM: Final = Path("/proc/sys/net/ipv4/tcp_rmem")
_STOP_S: Final = 2.0
_PAYLOAD_SHARE: Final = 0.5
"""The part of a receive buffer that data can use. The kernel needs the rest to manage packets."""


def check_receive_buffer(subject: Subject, load_bytes_per_s: float, tcp_rmem: Path = _TCP_RMEM) -> Finding:
    """Check that one connection's receive buffer can hold what arrives in 2 s.

    ``tcp_rmem`` has the smallest, the initial and the largest size of a receive buffer, in bytes. The gateway
    has the kernel provide the largest one (gateway/stream/tcp.py).
    """
    if not load_bytes_per_s:
        return subject.not_tested(CHECK, "no frames arrived")
    try:
        smallest, initial, largest = map(int, tcp_rmem.read_text("ascii").split())
    except (OSError, ValueError) as error:
        return subject.not_tested(CHECK, f"{tcp_rmem} cannot be read: {error}")
    holds_s = largest * _PAYLOAD_SHARE / load_bytes_per_s
    load = f"{load_bytes_per_s / 1e6:.2g} MB/s"
    if holds_s >= _STOP_S:
        text = f"the kernel holds what the server sends in {min(holds_s, 60):.0f} s ({load})"
        return subject.passing(CHECK, text)
    needed = _next_mebibyte(load_bytes_per_s * _STOP_S / _PAYLOAD_SHARE)
    return subject.failing(
        CHECK,
        f"the kernel holds only what the server sends in {holds_s:.1f} s ({load}); "
        "if the gateway stops for longer, frames may be lost",
        f'Run sysctl -w net.ipv4.tcp_rmem="{smallest} {initial} {needed}", and put '
        f"net.ipv4.tcp_rmem = {smallest} {initial} {needed} into /etc/sysctl.d/90-rtc3d.conf to keep it.",
    )


def _next_mebibyte(size: float) -> int:
    mebibyte = 1 << 20
    return (int(size) // mebibyte + 1) * mebibyte
