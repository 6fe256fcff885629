"""One client of the simulator: its packets in, replies and due data frames out, no I/O."""

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Final

from gateway.errors import CommandError, FrameError
from gateway.rtc3d.commands import (
    Bye,
    Command,
    Frequency,
    FrequencyDivisor,
    Rate,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
    parse_command,
)
from gateway.rtc3d.components import ByteOrder, ComponentType
from gateway.rtc3d.frames import byte_order_of, split_frame
from gateway.rtc3d.packets import Packet, PacketType, encode_packet, text_of
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import build_parameters
from gateway.rtc3d_server.frame_builder import DataPacket, FrameBuilder

VERSION: Final = "1.0"
NO_DATA: Final = encode_packet(PacketType.NO_DATA)
MAX_LATE_US: Final = 1_000_000
"""Frames of a stream that are later than this are dropped: the rest is caught up with."""

_PARAMETER_FIELDS: Final = {
    "general": "general",
    "3d": "markers",
    "6d": "tools",
    "analog": "analog",
    "force": "force",
    "events": "events",
}
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Server:
    """What a client asks the server for.

    ``frames(components)`` gives the builder of a choice of components. ``parameters()`` gives all
    sections of §6. ``measurement_us()`` is called whenever the client wants frames, and gives the
    time since the start of the measurement in µs, or None if none runs.
    """

    frames: Callable[[Sequence[ComponentType]], FrameBuilder]
    parameters: Callable[[], Parameters]
    measurement_us: Callable[[], int | None]


@dataclass(frozen=True, slots=True)
class _Request:
    """A SendCurrentFrame that waits for a frame later than ``after_us``."""

    frames: FrameBuilder
    after_us: int

    @property
    def due_us(self) -> int:
        return self.frames.time_us(self.frames.tick_after(self.after_us))


class _Stream:
    """The frames that are due to a client during one measurement by its StreamFrames (§5.3.5)."""

    def __init__(self, frames: FrameBuilder, rate: Rate | None, first_tick: int) -> None:
        self.frames = frames
        self._first_tick = first_tick
        stride = _stride(rate, frames.rate)
        self._numerator, self._denominator = stride.numerator, stride.denominator
        self._passed = 0  # frames of this stream that were sent or dropped
        self.tick = first_tick
        self.due_us = frames.time_us(first_tick)

    def move(self, count: int = 1) -> None:
        """Go on to the frame after the next ``count``: frame j is that of tick first + ⌈j · stride⌉."""
        self._passed += count
        self.tick = self._first_tick - (-self._passed * self._numerator // self._denominator)
        self.due_us = self.frames.time_us(self.tick)

    def num_due(self, elapsed_us: int) -> int:
        """Return how many frames are due and neither sent nor dropped."""
        ticks = self.frames.tick_after(elapsed_us) - 1 - self._first_tick
        return max(0, ticks * self._denominator // self._numerator + 1 - self._passed)


class ClientSession:
    """The protocol with one client, whatever the transport.

    Times are µs since the start of the measurement, which the caller keeps. The caller tells the
    client of ``measurement_started`` and ``measurement_stopped``, sends what ``answer`` returns, and
    takes the data frames from ``due`` when ``due_us`` has come.
    """

    def __init__(self, server: Server) -> None:
        self._server = server
        self.name = "client"
        """What log lines call it."""
        self._subscription: StreamFrames | None = None
        self._stream: _Stream | None = None  # of the subscription, while a measurement runs
        self._requests: deque[_Request] = deque()  # answered first in, first out
        self._last_us = -1  # time stamp of the newest frame that this client got
        self._events_from_us: int | None = None  # of the first event to send; None: no frames wanted yet
        self.byte_order: ByteOrder = "big"
        self.frames_dropped = 0
        """Frames of the stream that were never sent because the client or the server was late."""
        self.recording = False
        """Whether the client switched on a recording, as WaveFront's clients do (field note 16)."""
        self.said_bye = False

    @property
    def due_us(self) -> int | None:
        """When the next frame is due; None if none is wanted or no measurement runs."""
        first = (self._stream, self._requests[0] if self._requests else None)
        return min((wanted.due_us for wanted in first if wanted is not None), default=None)

    def measurement_started(self) -> None:
        """Begin the stream, if the client asked for one, with the measurement's first frame."""
        self._last_us = -1
        self._events_from_us = None
        if self._subscription is not None:
            self._events_from_us = 0
            self._begin_stream(self._subscription, 0)

    def measurement_stopped(self) -> list[bytes]:
        """Return a No Data packet for the stream and for each waiting request (§5.3.4, §5.3.5)."""
        waiting = len(self._requests) + (self._stream is not None)
        self._requests.clear()
        self._stream = None
        return [NO_DATA] * waiting

    def scene_changed(self) -> None:
        """Go on with the stream, from its next frame on, in frames of the server's new scene."""
        if self._stream is not None and self._subscription is not None:
            self._begin_stream(self._subscription, self._stream.due_us)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a client's packet, each one packet."""
        match packet.type:
            case PacketType.COMMAND:
                try:
                    return self._obey(parse_command(packet.body), packet.body)
                except CommandError as error:
                    return [error_packet(str(error))]
            case PacketType.DATA:
                return self._switch_recording(packet.body)
            case _:
                return [
                    error_packet(
                        f"Packets of type {packet.type} are not accepted; commands have type 1 (string)"
                    )
                ]

    def due(self, elapsed_us: int) -> Iterator[DataPacket]:
        """Give the frames that are due, oldest first.

        Lazily: a frame that is not taken is not sent, and stays due.
        """
        self.drop_due(elapsed_us - MAX_LATE_US)
        while self._stream is not None and self._stream.due_us <= elapsed_us:
            stream = self._stream
            tick = stream.tick
            stream.move()
            data = self._build(stream.frames, tick)
            if data.components:
                yield data
        while self._requests and self._requests[0].due_us <= elapsed_us:
            frames = self._requests.popleft().frames
            yield self._build(frames, frames.tick_after(elapsed_us) - 1)

    def drop_due(self, elapsed_us: int) -> None:
        """Drop the stream's frames that were due by then; their events come with the next frame."""
        stream = self._stream
        if stream is None or stream.due_us > elapsed_us:
            return
        count = stream.num_due(elapsed_us)
        stream.move(count)
        if stream.frames.measured:
            self.frames_dropped += count

    def _obey(self, command: Command, body: bytes) -> list[bytes]:
        acknowledgement = encode_packet(PacketType.COMMAND, f"OK-{text_of(body)}".encode("latin-1"))
        match command:
            case Version(number) if number != VERSION:
                return [
                    error_packet(f"Version {number} is not supported; this server speaks version {VERSION}")
                ]
            case SetByteOrder(byte_order):
                self.byte_order = byte_order
            case SendParameters(sections):
                return [encode_packet(PacketType.XML, build_parameters(self._parameters(sections)))]
            case SendCurrentFrame() | StreamFrames():
                return [acknowledgement, *self._want_frames(command)]
            case StopStreaming():
                self._subscription = self._stream = None
                if not self._requests:
                    self._events_from_us = None
            case Bye():
                self.said_bye = True
                return [encode_packet(PacketType.COMMAND, b"bye")]  # exactly so: field note 14
        return [acknowledgement]

    def _parameters(self, sections: Sequence[str]) -> Parameters:
        known = self._server.parameters()
        if not sections:
            return known
        unwanted = {field: None for section, field in _PARAMETER_FIELDS.items() if section not in sections}
        return replace(known, **unwanted)

    def _want_frames(self, command: SendCurrentFrame | StreamFrames) -> list[bytes]:
        """Note which frames the client wants; return a No Data packet if no measurement runs."""
        elapsed_us = self._server.measurement_us()
        if isinstance(command, StreamFrames):
            self._subscription = command
        if elapsed_us is None:
            return [NO_DATA]
        if isinstance(command, StreamFrames):
            self._begin_stream(command, elapsed_us)
        else:
            self._requests.append(_Request(self._server.frames(command.components), self._last_us))
        if self._events_from_us is None:
            self._events_from_us = elapsed_us
        return []

    def _begin_stream(self, command: StreamFrames, elapsed_us: int) -> None:
        frames = self._server.frames(command.components)
        # the frame of this moment is new to the client unless it is the last that it got
        first_tick = frames.tick_after(max(elapsed_us - 1, self._last_us))
        self._stream = _Stream(frames, command.rate, first_tick)

    def _build(self, frames: FrameBuilder, tick: int) -> DataPacket:
        time_us = frames.time_us(tick)
        self._last_us = max(self._last_us, time_us)
        if not frames.has_events:
            return frames.packet(self.byte_order, tick)
        start_us = time_us if self._events_from_us is None else self._events_from_us
        events = frames.events(start_us, time_us + 1)
        self._events_from_us = max(start_us, time_us + 1)
        return frames.packet(self.byte_order, tick, events)

    def _switch_recording(self, body: bytes) -> list[bytes]:
        try:
            components = split_frame(body, byte_order_of(body, self.byte_order)).components
        except FrameError as error:
            return [error_packet(f"Not a data frame: {error}")]
        if len(components) == 1 and components[0].type is ComponentType.EVENT:
            events = components[0].items()
            if components[0].frame_number == -1 and events["id"].tolist() in ([0], [1]):
                self.recording = bool(events["id"][0])
                _log.info("%s: recording %s", self.name, "started" if self.recording else "stopped")
                return []
        return [
            error_packet(
                "The only data frame accepted is a recording control: one event, 1 to start, 0 to stop"
            )
        ]


def _stride(rate: Rate | None, base_rate: Fraction) -> Fraction:
    """Return how many ticks of the real-time rate are between two frames, 1 at least (§5.3.5)."""
    match rate:
        case FrequencyDivisor(divisor):
            return Fraction(divisor)
        case Frequency(hz):
            return max(Fraction(1), base_rate / Fraction(hz).limit_denominator(1_000_000))
        case _:
            return Fraction(1)


def error_packet(text: str) -> bytes:
    """Return an error packet (type 0) as NDI's servers word it (field note 1)."""
    return encode_packet(PacketType.ERROR, f"Error-{text}".encode("ascii", "replace"))
