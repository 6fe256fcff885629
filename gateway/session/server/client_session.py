"""The server's side of the protocol with one client: packets in, replies and due data frames out, no I/O."""

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Protocol

from gateway.errors import CommandError, FrameError
from gateway.rtc3d.commands import (
    Bye,
    Command,
    ControlRecording,
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
    recording_duration_s,
)
from gateway.rtc3d.components import ByteOrder, ComponentType
from gateway.rtc3d.frames import detect_byte_order, split_frame
from gateway.rtc3d.packets import Packet, PacketType, decode_text, encode_packet
from gateway.session.server.scene import NOT_YET_US, DataPacket, FrameSource

VERSION: Final = "1.0"
NO_DATA: Final = encode_packet(PacketType.NO_DATA)

MAX_FRAME_REQUESTS: Final = 1000
"""How many SendCurrentFrame of a client wait at most. They may wait for components that never come."""

_log = logging.getLogger(__name__)


class SessionHost(Protocol):
    """What a session needs from its connection and the server."""

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Return the frames with these components; an empty sequence means all."""

    def parameters_xml(self, sections: Sequence[str]) -> bytes:
        """Return the XML of some sections of §6 (keys of SECTIONS), or of all if it is empty."""

    def frames_requested(self) -> int | None:
        """Note that the client requests frames; return the measurement's time in µs, None without one."""

    def record_for(self, duration_s: float | None) -> None:
        """Call ``end_recording`` after this time, or never if it is None; calls before do not count any more.

        The session calls it when the client starts or stops a recording.
        """


class ClientSession:
    """The protocol with one client, independent of the transport.

    All times are in µs since the measurement's start; the caller has the clock. It calls
    ``measurement_started``, ``measurement_stopped`` and ``scene_changed``, sends the packets that ``answer``
    returns, and at ``due_us`` those that ``due_frames`` yields.
    """

    def __init__(self, host: SessionHost) -> None:
        self._host = host
        self.name = "client"
        """The client's name in log messages."""
        self._stream_command: StreamFrames | None = None  # the newest one, until StreamFrames Stop
        self._schedule: FrameSchedule | None = None  # of that command, while a measurement is running
        self._frame_requests: deque[FrameRequest] = deque()  # SendCurrentFrame; answered in order
        self._progress = FrameProgress()
        self.byte_order: ByteOrder = "big"
        """The byte order of the client's data frames (§4.3)."""
        self.frames_dropped = 0
        """The number of stream frames that were dropped because the client or the server was late."""
        self.frames_without_events = 0
        """The number of frames that lack events, because too many waited for the client."""
        self.is_recording = False
        """Whether the client started a recording, as WaveFront's clients do (field notes 16, 18 and 26)."""
        self.said_bye = False
        """Whether the client sent Bye: close the connection once the replies are sent."""

    @property
    def due_us(self) -> int | None:
        """When the next frame is due; None without a request, a known frame, or a measurement."""
        due_us = NOT_YET_US if self._schedule is None else self._schedule.due_us
        if self._frame_requests:
            due_us = min(due_us, self._frame_requests[0].due_us)
        return None if due_us == NOT_YET_US else due_us

    @property
    def wants_frames(self) -> bool:
        """Whether the client streams, or waits for a frame."""
        return self._stream_command is not None or self.waits_for_frame

    @property
    def waits_for_frame(self) -> bool:
        """Whether the client waits for an answer to SendCurrentFrame."""
        return bool(self._frame_requests)

    def measurement_started(self) -> None:
        """Start the client's stream, if it requested one, with the measurement's first frame."""
        self._progress = FrameProgress()
        if self._stream_command is not None:
            self._progress.events_from_us = 0
            self._start_stream(self._stream_command, 0)

    def measurement_stopped(self) -> list[bytes]:
        """Return a No Data packet for the stream and for each waiting request (§5.3.4, §5.3.5)."""
        num_waiting = len(self._frame_requests) + (self._schedule is not None)
        self._frame_requests.clear()
        self._schedule = None
        return [NO_DATA] * num_waiting

    def scene_changed(self, elapsed_us: int) -> None:
        """Continue the stream with frames of the new scene, from the next frame on."""
        if self._schedule is not None and self._stream_command is not None:
            due_us = self._schedule.due_us
            self._start_stream(self._stream_command, elapsed_us if due_us == NOT_YET_US else due_us)

    def answer(self, packet: Packet) -> list[bytes]:
        """Execute a client's packet; return the replies, each one packet."""
        match packet.type:
            case PacketType.COMMAND:
                try:
                    return self._execute(parse_command(packet.body), packet.body)
                except CommandError as error:
                    return [error_packet(str(error))]
            case PacketType.DATA:
                try:
                    start = recording_switch(packet.body, self.byte_order)
                except FrameError as error:
                    return [error_packet(f"Not a data frame: {error}")]
                if start is not None:
                    self._set_recording(start=start)
                    return []
                text = "The only data frame accepted is a recording control: one event, 1 to start, 0 to stop"
            case _:
                text = f"Packets of type {packet.type} are not accepted; commands have type 1 (string)"
        return [error_packet(text)]

    def due_frames(self, elapsed_us: int) -> Iterator[DataPacket]:
        """Yield the frames that are due, oldest first. Frames that the caller does not take stay due."""
        if self._schedule is not None:
            self._drop_frames(self._schedule, self._schedule.frames.oldest_us(elapsed_us))
        while self._schedule is not None and self._schedule.due_us <= elapsed_us:
            schedule = self._schedule
            tick = schedule.tick
            schedule.advance()
            frame = self._build(schedule.frames, tick)
            if frame.components:
                yield frame
        while self._frame_requests and self._frame_requests[0].due_us <= elapsed_us:
            frames = self._frame_requests.popleft().frames
            yield self._build(frames, frames.tick_after(elapsed_us) - 1)

    def drop_due_frames(self, elapsed_us: int) -> None:
        """Drop the stream's frames that are due; their events go into the next frame."""
        if self._schedule is not None:
            self._drop_frames(self._schedule, elapsed_us)

    def _drop_frames(self, schedule: "FrameSchedule", until_us: int) -> None:
        if schedule.due_us > until_us:
            return
        count = schedule.num_due(until_us)
        schedule.advance(count)
        if schedule.frames.measured:  # a stream that has only events loses nothing
            self.frames_dropped += count

    def _execute(self, command: Command, body: bytes) -> list[bytes]:
        acknowledgement = encode_packet(PacketType.COMMAND, f"OK-{decode_text(body)}".encode("latin-1"))
        match command:
            case Version(number) if number != VERSION:
                text = f"Version {number} is not supported; this server speaks version {VERSION}"
                return [error_packet(text)]
            case SetByteOrder(byte_order):
                self.byte_order = byte_order
            case SendParameters(sections):
                return [encode_packet(PacketType.XML, self._host.parameters_xml(sections))]
            case SendCurrentFrame() if len(self._frame_requests) >= MAX_FRAME_REQUESTS:
                return [error_packet(f"{MAX_FRAME_REQUESTS} requests for the current frame wait already")]
            case SendCurrentFrame() | StreamFrames():
                return [acknowledgement, *self._request_frames(command)]
            case StopStreaming():
                self._stream_command = self._schedule = None
                if not self._frame_requests:
                    self._progress.events_from_us = None
            case ControlRecording(start, options):
                self._set_recording(start=start, options=options)
            case Bye():
                self.said_bye = True
                return [encode_packet(PacketType.COMMAND, b"bye")]  # exactly these bytes: field note 14
        return [acknowledgement]

    def _request_frames(self, command: SendCurrentFrame | StreamFrames) -> list[bytes]:
        """Store a request for frames; return a No Data packet if no measurement is running."""
        elapsed_us = self._host.frames_requested()
        if isinstance(command, StreamFrames):
            self._stream_command = command
        if elapsed_us is None:
            return [NO_DATA]
        if isinstance(command, StreamFrames):
            self._start_stream(command, elapsed_us)
        else:
            frames = self._host.frames(command.components)
            self._frame_requests.append(FrameRequest(frames, self._progress.newest_us))
        if self._progress.events_from_us is None:
            self._progress.events_from_us = elapsed_us
        return []

    def _start_stream(self, command: StreamFrames, elapsed_us: int) -> None:
        frames = self._host.frames(command.components)
        # A frame that is due right now is sent, unless the client already has it. A request during a stream
        # continues that stream, so frames that are overdue are sent, too.
        start_us = elapsed_us if self._schedule is None else min(elapsed_us, self._schedule.due_us)
        first_tick = frames.tick_after(max(start_us - 1, self._progress.newest_us))
        self._schedule = FrameSchedule(frames, command.rate, first_tick)

    def _build(self, frames: FrameSource, tick: int) -> DataPacket:
        progress, time_us = self._progress, frames.time_us(tick)
        progress.newest_us = max(progress.newest_us, time_us)
        if not frames.has_events:
            return frames.packet(self.byte_order, tick)
        events_from_us = time_us if progress.events_from_us is None else progress.events_from_us
        progress.events_from_us = max(events_from_us, time_us + 1)
        packet = frames.packet(self.byte_order, tick, events_from_us)
        self.frames_without_events += packet.lacks_events
        return packet

    def end_recording(self) -> None:
        """End the recording, because its duration is over."""
        self._set_recording(start=False)

    def _set_recording(self, *, start: bool, options: str = "") -> None:
        """Start or stop a recording. Raises CommandError if the duration in ``options`` is none."""
        self._host.record_for(recording_duration_s(options))
        self.is_recording = start
        _log.info("%s: recording %s", self.name, "started" if start else "stopped")


# Which frames a client gets, and when (§5.3.4, §5.3.5) --------------------------------------

_SAME_RATE: Final = Fraction(101, 100)
"""Measured rates within this factor are one rate."""


@dataclass(slots=True)
class FrameProgress:
    """How far a client has got in the frames and events of a measurement."""

    newest_us: int = -1
    """The time stamp of the newest frame that was built for it."""

    events_from_us: int | None = None
    """When the first event to send occurs; None while no frames are requested."""


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """A SendCurrentFrame that waits for a frame later than ``after_us``."""

    frames: FrameSource
    after_us: int

    @property
    def due_us(self) -> int:
        """When the frame is due, in µs since the measurement's start; NOT_YET_US if this is not known."""
        return self.frames.time_us(self.frames.tick_after(self.after_us))


class FrameSchedule:
    """The frames of a client's StreamFrames during one measurement (§5.3.5).

    Frame j of the stream (from 0) is the frame of tick ⌈first + j · stride⌉. If the rate of the frames
    changes, so that ``Frequency:n`` needs another stride, the stream continues with that one.
    """

    def __init__(self, frames: FrameSource, rate: Rate | None, first_tick: int) -> None:
        self.frames = frames
        self._rate = rate
        self._base_rate = frames.rate
        self._set_stride(Fraction(first_tick))
        self.tick = first_tick
        """The tick of the next frame."""

    def _set_stride(self, first: Fraction) -> None:
        """Count the frames of this stream from the one at ``first`` on."""
        stride = Fraction(1)  # ticks from one frame to the next, at least 1 (§5.3.5)
        match self._rate:
            case FrequencyDivisor(divisor):
                stride = Fraction(divisor)
            case Frequency(hz):
                stride = max(stride, self._base_rate / Fraction(hz).limit_denominator(1_000_000))
        # As integers with one denominator, because this is computed for every frame of every client.
        self._denominator = first.denominator * stride.denominator
        self._first = first.numerator * stride.denominator
        self._stride = stride.numerator * first.denominator
        self._num_passed = 0  # frames that were sent or dropped

    @property
    def due_us(self) -> int:
        """When the next frame is due; NOT_YET_US if this is not known."""
        return self.frames.time_us(self.tick)

    def advance(self, count: int = 1) -> None:
        """Advance by ``count`` frames, which were sent or dropped."""
        if isinstance(self._rate, Frequency):
            rate = self.frames.rate
            if not (self._base_rate < rate * _SAME_RATE and rate < self._base_rate * _SAME_RATE):
                self._base_rate = rate
                position = Fraction(self._first + self._num_passed * self._stride, self._denominator)
                self._set_stride(position.limit_denominator(1000))
        self._num_passed += count
        self.tick = -(-(self._first + self._num_passed * self._stride) // self._denominator)

    def num_due(self, elapsed_us: int) -> int:
        """Return how many frames are due at ``elapsed_us``."""
        last_tick = self.frames.tick_after(elapsed_us) - 1
        num_begun = (last_tick * self._denominator - self._first) // self._stride + 1
        return max(0, num_begun - self._num_passed)


def recording_switch(body: bytes, byte_order: ByteOrder) -> bool | None:
    """Return whether a client's data frame starts a recording (True) or stops it (False; field note 16).

    Returns None if the frame is something else; raises FrameError if it is none.
    """
    components = split_frame(body, detect_byte_order(body, byte_order)).components
    if len(components) == 1 and components[0].type is ComponentType.EVENT:
        events = components[0].items()
        if components[0].frame_number == -1 and events["id"].tolist() in ([0], [1]):
            return bool(events["id"][0])
    return None


def error_packet(text: str) -> bytes:
    """Return an error packet (type 0), worded as by NDI's servers (field note 1)."""
    return encode_packet(PacketType.ERROR, f"Error-{text}".encode("ascii", "replace"))
