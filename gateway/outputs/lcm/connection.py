"""Opening LCM, and explaining failures to open and to send."""

import contextlib
import errno
import ipaddress
import os
import select
import socket
import struct
import sys
from pathlib import Path
from typing import Final
from urllib.parse import SplitResult, urlsplit, urlunsplit

import lcm

from gateway.errors import OutputError

DEFAULT_GROUP: Final = "239.255.76.67"
DEFAULT_PORT: Final = 7667
"""LCM's own defaults for multicast."""

MULTICAST_SCHEMES: Final = ("udpm", "mpudpm")
_RECEIVE_BUFFER_BYTES: Final = 4 * 1024 * 1024
_ROUTE_REQUEST: Final = struct.Struct("=IHHIIBBBBBBBBIHH4s")
"""The structures nlmsghdr, rtmsg, and rtattr with an IPv4 address."""

_RTM_GETROUTE: Final = 26
_RTA_DST: Final = 1
_RTA_OIF: Final = 4
_NLMSG_ERROR: Final = struct.pack("=H", 2)

_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")
_SEND_BUFFER_BYTES: Final = 4 * 1024 * 1024
_OPEN_FILES: Final = Path("/proc/self/fd")

QUEUE_MESSAGES: Final = 10_000
"""Messages that may wait. With LCM's own default, 30, a process that pauses for a moment loses messages."""

BLOCKING_SCHEMES: Final = ("tcpq", "file")
"""Schemes that open and publish synchronously: a peer or disk that stalls blocks the caller."""


def scheme_of(url: str) -> str:
    """Return the scheme of an LCM URL, which selects how LCM sends: udpm, tcpq, …"""
    return url.partition("://")[0]


def multicast_interface(url: str) -> str | None:
    """Return the name of the network interface on which LCM joins the group of a multicast URL.

    Returns None if the URL is of another kind, or if LCM itself would reject it. Raises OSError if there is
    no such interface.
    """
    destination = multicast_destination(url)
    if destination is None:
        return None
    # rtnetlink(7): a request for the route to an address, whose reply has the interface. The local address of
    # a connected socket does not show it: a route through lo can use the address of another interface.
    request = _ROUTE_REQUEST.pack(
        *(_ROUTE_REQUEST.size, _RTM_GETROUTE, 1, 0, 0),
        *(socket.AF_INET, 32, 0, 0, 0, 0, 0, 0, 0),
        *(8, _RTA_DST, ipaddress.IPv4Address(destination[0]).packed),
    )
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.send(request)
        reply = kernel.recv(65536)
    if reply[4:6] == _NLMSG_ERROR:
        number = -int.from_bytes(reply[16:20], sys.byteorder, signed=True)
        raise OSError(number, os.strerror(number))
    attribute = _ROUTE_REQUEST.size - 8
    while attribute + 8 <= len(reply):
        length, kind, index = struct.unpack_from("=HHI", reply, attribute)
        if kind == _RTA_OIF:
            return socket.if_indextoname(index)
        attribute += (max(length, 4) + 3) & ~3
    raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))


def split_url(url: str) -> SplitResult:
    """Return the parts of an LCM URL; only the scheme if it is one that LCM itself rejects."""
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit(f"{scheme_of(url)}://")


def multicast_destination(url: str) -> tuple[str, int] | None:
    """Return group and port; None if this is no multicast URL, or one that LCM itself rejects."""
    if scheme_of(url) not in MULTICAST_SCHEMES:
        return None
    try:
        parts = urlsplit(url)
        return str(ipaddress.IPv4Address(parts.hostname or DEFAULT_GROUP)), parts.port or DEFAULT_PORT
    except ValueError:
        return None


def multicast_problem(url: str) -> str:
    """Return why the system cannot send to a multicast URL, and what to do; "" if it can.

    LCM itself only prints the reason to stderr and raises RuntimeError without it.
    """
    destination = multicast_destination(url)
    if destination is None:
        return ""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(destination)
    except OSError as error:
        return (
            f"no multicast to {url}: {error}; bring a network interface up, or give it a multicast route: "
            "ip route add 224.0.0.0/4 dev INTERFACE"
        )
    return ""


def receiving_url(url: str) -> str:
    """Return ``url`` with a receive buffer for bursts, unless it sets one or its scheme has none.

    LCM's default is the kernel's, which holds about 100 messages. LCM writes a warning on stderr if the
    kernel does not allow the size, so this asks for no more than that.
    """
    if scheme_of(url) not in MULTICAST_SCHEMES or "recv_buf_size" in url:
        return url
    try:
        largest = int(_RMEM_MAX.read_text())
    except (OSError, ValueError):
        return url  # not Linux, or a sandbox that hides it
    return f"{url}{'&' if '?' in url else '?'}recv_buf_size={min(_RECEIVE_BUFFER_BYTES, largest)}"


def _with_address(url: str) -> str:
    """Return a tcpq URL with the IPv4 address of its host; other URLs have no host names.

    LCM itself takes addresses only. With a name, it connects to this computer and reports no error.
    Raises OutputError if the name is not known.
    """
    if scheme_of(url) != "tcpq":
        return url
    parts = urlsplit(url)
    name = parts.netloc.rpartition(":")[0] if ":" in parts.netloc else parts.netloc
    if not name:
        return url
    try:
        address = socket.gethostbyname(name)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(
            f"the host name {name!r} of {url} cannot be resolved: {reason}; "
            "check lcm.url and the name server (DNS), or use an IP address",
            cause="not open",
        ) from error
    return urlunsplit(parts._replace(netloc=address + parts.netloc.removeprefix(name)))


def open_lcm(url: str) -> lcm.LCM:
    """Return an LCM object on ``url``. Raises OutputError with the reason and the remedy.

    Blocks if the scheme is in BLOCKING_SCHEMES.
    """
    problem = multicast_problem(url)
    if problem:
        raise OutputError(problem, cause="not open")
    try:
        return lcm.LCM(_with_address(url))
    except RuntimeError as error:
        raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error


class Waiting:
    """The wait of a thread for what arrives on LCM, which other threads can end."""

    def __init__(self) -> None:
        self._woken, self._waker = socket.socketpair()

    def wait(self, connection: lcm.LCM | socket.socket) -> bool:
        """Wait until something has arrived, or ``wake`` is called; return whether something has.

        Raises OSError if the connection is closed.
        """
        number, woken = connection.fileno(), self._woken.fileno()
        if number < 0:
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
        poll = select.poll()
        poll.register(number, select.POLLIN)
        poll.register(woken, select.POLLIN)
        ready = {each for each, _ in poll.poll()}
        if woken in ready:
            self._woken.recv(4096)
        return number in ready

    def wake(self) -> None:
        """End the wait, or the next one. Called in any thread."""
        with contextlib.suppress(OSError):  # the thread has ended, or is about to wake up
            self._waker.send(b"\0", socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Free the sockets."""
        self._woken.close()
        self._waker.close()


def reconnect(connection: lcm.LCM, channel: str) -> None:
    """Connect to the relay (tcpq) again; LCM then renews its subscriptions. Raises OSError.

    LCM does this when it publishes, but not when it waits for messages: so an empty message goes to
    ``channel``, which has no subscribers. A new LCM object is no alternative, because freeing the lost one
    would connect, too, and stop every other thread of the process meanwhile.
    """
    connection.publish(channel, b"")


def open_lcm_to_send(url: str) -> lcm.LCM:
    """Return an LCM object that sends to a multicast URL without ever waiting. Raises OutputError.

    LCM's socket waits while its buffer is full: with a network interface of 1 Mbit/s, for up to 0.6 s for
    each message. Now the buffer is as large as the kernel allows, and if it is full, ``publish`` raises
    OSError. LCM does not give its socket away, so this looks for the UDP sockets that have appeared.
    """
    before = _open_files()
    connection = open_lcm(url)
    if scheme_of(url) in MULTICAST_SCHEMES:
        for number in _open_files() - before:
            with contextlib.suppress(OSError):  # a file, or closed meanwhile
                _set_up_to_send(number)
    return connection


def _open_files() -> set[int]:
    try:
        return {int(name) for name in os.listdir(_OPEN_FILES)}  # noqa: PTH208 - only the names
    except OSError:
        return set()  # not Linux, or a sandbox that hides it: LCM waits


def _set_up_to_send(number: int) -> None:
    """Let a UDP socket never wait. Raises OSError if ``number`` is no socket."""
    duplicate = os.dup(number)
    try:
        same = socket.socket(fileno=duplicate)
    except OSError:
        # It may be one end of another thread's pipe, whose other end waits until every copy is closed.
        os.close(duplicate)
        raise
    with same:
        if same.type == socket.SOCK_DGRAM:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            same.setblocking(False)


def send_problem(url: str, error: OSError) -> str:
    """Return why LCM did not send to ``url``, and what to do."""
    if error.errno == errno.EAGAIN:
        return (
            f"the network interface does not take messages to {url} fast enough; use a faster one, "
            "or set lcm.max_rate_hz"
        )
    return multicast_problem(url) or f"LCM did not send to {url}: {error}; check lcm.url"
