"""Check of this computer's clock, on which utime and capture_utime depend."""

import ctypes
from collections.abc import Sequence
from typing import Final

from gateway.findings import Finding, Subject

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
