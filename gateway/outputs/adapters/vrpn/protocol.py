"""VRPN's network protocol, version 07.35, as a server speaks it, without I/O.

VRPN has no specification. This is the format of libvrpn: vrpn_Connection.C, vrpn_BaseClass.C, vrpn_Tracker.C.
Both sides of a TCP connection begin with a cookie of 24 bytes. Then they send messages: a header of 24 bytes,
and a body that is padded to a multiple of 8. Everything is big-endian. Senders (devices) and types of
messages have numbers, which each side chooses for its own messages and describes by a name before it uses
them.
"""

import re
import struct
from typing import Final

from gateway.errors import PeerError
from gateway.runtime.safe_text import quoted

COOKIE_BYTES: Final = 24
COOKIE: Final = b"vrpn: ver. 07.35  0".ljust(COOKIE_BYTES, b"\0")
"""Magic and version, then two spaces and a digit: whether the other side shall write a log. 0 means no."""

COOKIE_START: Final = b"vrpn: ver. 07."
"""libvrpn accepts any minor version, too."""

MAX_NAME_BYTES: Final = 95
"""The longest name. libvrpn's buffer for its description has 100 bytes, with the length and a NUL."""

MAX_IDS: Final = 2000
"""Senders and types have numbers below this; libvrpn's tables have no more entries."""

MAX_BODY_BYTES: Final = 64_000
"""libvrpn's buffer for messages."""

# Length of header and body without padding, time in s and µs, sender, type, and a number that nobody reads.
_HEADER: Final = struct.Struct(">IIIiiI")
_HEADER_BYTES: Final = 24
_ALIGNMENT: Final = 8
_LENGTH: Final = struct.Struct(">I")

_SENDER_DESCRIPTION: Final = -1
_TYPE_DESCRIPTION: Final = -2
"""The types of messages that describe a number; the number is in the header's field for the sender."""

_MAX_DESCRIPTION_BYTES: Final = 100

# A header; the number of the sensor and padding; position and orientation.
_POSE: Final = struct.Struct(">IIIiiI4x4x7d")
_POSE_BYTES: Final = 88  # without padding: 64 is a multiple of 8

_POSE_TYPE: Final = 0
_PONG_TYPE: Final = 1
_PING_NAME: Final = b"vrpn_Base ping_message"
_TYPE_NAMES: Final = {_POSE_TYPE: b"vrpn_Tracker Pos_Quat", _PONG_TYPE: b"vrpn_Base pong_message"}

_CALLBACK_REQUEST: Final = re.compile(rb"[^\s\0]{1,255} ([0-9]{1,5})\0*")
_FIRST_USER_PORT: Final = 1024
_MAX_PORT: Final = 65535


class ClientReader:
    """Reads the bytes of one client, however they are split. It keeps no more than a description's bytes.

    ``has_cookie`` is True once the client has sent a cookie, and has thereby shown that it speaks VRPN.
    """

    def __init__(self) -> None:
        self.has_cookie = False
        self._waiting = bytearray()  # the beginning of a cookie, a header or a description
        self._num_skipped_bytes = 0  # how many of the next bytes belong to a body that nobody reads
        self._senders: dict[int, str] = {}
        self._ping_type: int | None = None

    @property
    def num_waiting_bytes(self) -> int:
        """How many bytes are kept until more arrive."""
        return len(self._waiting)

    def receive(self, data: bytes) -> list[str]:
        """Return the name of the device for each ping in ``data``.

        Raises PeerError if this is not VRPN; then the connection must end.
        """
        self._waiting += data
        if not self.has_cookie and not self._take_cookie():
            return []
        pinged: list[str] = []
        start = 0
        while True:
            skipped = min(self._num_skipped_bytes, len(self._waiting) - start)
            self._num_skipped_bytes -= skipped
            start += skipped
            if len(self._waiting) - start < _HEADER_BYTES:
                break
            length, _, _, sender, type_, _ = _HEADER.unpack_from(self._waiting, start)
            body_bytes = length - _HEADER_BYTES  # without padding
            if not 0 <= body_bytes <= MAX_BODY_BYTES:
                most = _HEADER_BYTES + MAX_BODY_BYTES
                raise PeerError(f"a message of {length} bytes; expected {_HEADER_BYTES} to {most}")
            padded_bytes = _padded(body_bytes)
            if type_ in (_SENDER_DESCRIPTION, _TYPE_DESCRIPTION):
                if body_bytes > _MAX_DESCRIPTION_BYTES:
                    raise PeerError(
                        f"a description of {body_bytes} bytes, more than {_MAX_DESCRIPTION_BYTES}"
                    )
                if len(self._waiting) - start < _HEADER_BYTES + padded_bytes:
                    break
                body_start = start + _HEADER_BYTES
                self._describe(type_, sender, bytes(self._waiting[body_start : body_start + body_bytes]))
            elif type_ == self._ping_type and sender in self._senders:
                pinged.append(self._senders[sender])
            start += _HEADER_BYTES
            self._num_skipped_bytes = padded_bytes
        del self._waiting[:start]
        return pinged

    def _take_cookie(self) -> bool:
        begin = bytes(self._waiting[: len(COOKIE_START)])
        if begin != COOKIE_START[: len(begin)]:
            first = quoted(begin.decode("latin-1"))
            raise PeerError(f"it does not speak VRPN 07; its first bytes are {first}")
        self.has_cookie = len(self._waiting) >= COOKIE_BYTES
        if self.has_cookie:
            del self._waiting[:COOKIE_BYTES]
        return self.has_cookie

    def _describe(self, type_: int, number: int, body: bytes) -> None:
        if not 0 <= number < MAX_IDS:
            raise PeerError(f"it describes number {number}, which is not from 0 to {MAX_IDS - 1}")
        name = body[_LENGTH.size :].partition(b"\0")[0]
        if type_ == _SENDER_DESCRIPTION:
            self._senders[number] = name.decode(errors="replace")
        elif name == _PING_NAME:
            self._ping_type = number
        elif number == self._ping_type:
            self._ping_type = None


def _padded(num_bytes: int) -> int:
    return -(-num_bytes // _ALIGNMENT) * _ALIGNMENT


def _message(sender: int, type_: int, utime: int, body: bytes = b"") -> bytes:
    seconds, microseconds = _timeval(utime)
    header = _HEADER.pack(_HEADER_BYTES + len(body), seconds, microseconds, sender, type_, 0)
    return header + body + bytes(_padded(len(body)) - len(body))


def _timeval(utime: int) -> tuple[int, int]:
    """Return seconds and microseconds of a time in µs since the Unix epoch; 32 bits hold it until 2106."""
    seconds, microseconds = divmod(utime, 1_000_000)
    return seconds & 0xFFFF_FFFF, microseconds


def _description(type_: int, number: int, name: bytes) -> bytes:
    return _message(number, type_, 0, _LENGTH.pack(len(name) + 1) + name + b"\0")


TYPE_DESCRIPTIONS: Final = b"".join(
    _description(_TYPE_DESCRIPTION, number, name) for number, name in _TYPE_NAMES.items()
)
"""The descriptions of the types of messages that the server sends."""


def describe_tracker(number: int, name: str) -> bytes:
    """Return the message that gives a tracker's number a name of at most MAX_NAME_BYTES."""
    return _description(_SENDER_DESCRIPTION, number, name.encode())


def encode_pong(number: int, utime: int) -> bytes:
    """Return the answer of a tracker to a ping, at ``utime`` in µs since the Unix epoch."""
    return _message(number, _PONG_TYPE, utime)


def encode_pose(number: int, utime: int, pose: tuple[float, ...]) -> bytes:
    """Return the pose of a tracker: x, y, z in metres and the quaternion x, y, z, w come first in ``pose``.

    ``utime`` is its time in µs since the Unix epoch. The sensor is always 0: a tool is a tracker of its own.
    """
    return _POSE.pack(_POSE_BYTES, *_timeval(utime), number, _POSE_TYPE, 0, *pose[:7])


def callback_port(datagram: bytes) -> int | None:
    """Return the TCP port at which a client wants to be called back; None if this is no such request.

    The client sends its address and the port as text. The address is not used: a client can be wrong about
    it, or lie. Ports of system services are not accepted, because VRPN clients listen on free ports.
    """
    match = _CALLBACK_REQUEST.fullmatch(datagram)
    if match is None:
        return None
    port = int(match[1])
    return port if _FIRST_USER_PORT <= port <= _MAX_PORT else None
