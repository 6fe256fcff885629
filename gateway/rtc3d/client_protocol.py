"""The client's side of one RTC3D connection, without I/O: bytes in, frames, events and bytes out.

This is the only table of transitions in the gateway. The state of a stream is derived from these states.
"""

from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from gateway.errors import ClosedError, FrameError, LinkError, PacketError, ServerError
from gateway.rtc3d.commands import (
    Bye,
    Command,
    SendCurrentFrame,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    encode_command,
)
from gateway.rtc3d.components import LONG_EVENT, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import FrameReader, RawFrame, announced_components, detect_byte_order, encode_frame
from gateway.rtc3d.packets import (
    ALL_PACKETS,
    DATA,
    DEFAULT_MAX_C3D_BYTES,
    DEFAULT_MAX_PACKET_BYTES,
    FilePiece,
    Packet,
    PacketReader,
    PacketType,
    decode_text,
    encode_packet,
)
from gateway.rtc3d.reply_matcher import Match, ReplyMatcher
from gateway.runtime.safe_text import safe_text


class ProtocolState(Enum):
    """The states: what the client has requested, and what the server sends."""

    IDLE = "idle"  # the server has accepted no request for frames, as far as the client knows
    REQUESTED = "requested"  # StreamFrames was sent; neither a frame nor No Data has arrived yet
    STREAMING = "streaming"
    NO_MEASUREMENT = "no measurement"
    STOPPED = "stopped"  # the server accepted StreamFrames Stop; a frame that still arrives was under way
    CLOSING = "closing"  # Bye was sent
    CLOSED = "closed"


class ProtocolInput(Enum):
    """The inputs that can change the state of a connection."""

    REQUEST_SENT = "StreamFrames sent"
    REQUEST_REFUSED = "StreamFrames refused"
    STOP_ACCEPTED = "StreamFrames Stop accepted"
    STOP_UNANSWERED = "StreamFrames Stop not answered"
    FRAME_RECEIVED = "a frame received"
    NO_DATA_RECEIVED = "No Data received"
    BYE_SENT = "Bye sent"
    CONNECTION_ENDED = "the connection ended"


_UNSTOPPED: Final = {
    ProtocolState.IDLE,
    ProtocolState.REQUESTED,
    ProtocolState.STREAMING,
    ProtocolState.NO_MEASUREMENT,
}
_TRANSITIONS: Final[dict[ProtocolInput, tuple[set[ProtocolState], ProtocolState]]] = {
    ProtocolInput.REQUEST_SENT: ({ProtocolState.IDLE, ProtocolState.STOPPED}, ProtocolState.REQUESTED),
    ProtocolInput.REQUEST_REFUSED: ({ProtocolState.REQUESTED}, ProtocolState.IDLE),
    # A reply does not always say what it answers (field note 20). What the server sends shows the truth: if
    # frames arrive although the server seems to have refused them, it has not.
    ProtocolInput.FRAME_RECEIVED: (_UNSTOPPED, ProtocolState.STREAMING),
    ProtocolInput.NO_DATA_RECEIVED: (_UNSTOPPED, ProtocolState.NO_MEASUREMENT),
    ProtocolInput.STOP_ACCEPTED: (_UNSTOPPED, ProtocolState.STOPPED),
    ProtocolInput.STOP_UNANSWERED: (_UNSTOPPED, ProtocolState.IDLE),  # the next frame shows if it was ignored
    ProtocolInput.BYE_SENT: (_UNSTOPPED | {ProtocolState.STOPPED}, ProtocolState.CLOSING),
    ProtocolInput.CONNECTION_ENDED: (set(ProtocolState), ProtocolState.CLOSED),
}
"""In which states each input changes the state, and to which. In other states, it changes nothing."""

_MAX_ERROR_BYTES: Final = 300  # of a server's error text, which goes into logs and status messages
_UNUSED_PARAMETER: Final = -1  # of an event (§7.7)


class Answered(NamedTuple):
    """The server answered ``command`` with ``packet``, which is not an error packet."""

    command: Command
    packet: Packet


class Refused(NamedTuple):
    """The server answered ``command`` with an error packet."""

    command: Command
    error: ServerError


class PossibleReply(NamedTuple):
    """A text that answers ``command``, or an earlier command that was not answered in time.

    Call ``ClientProtocol.assume_reply`` if no other reply follows soon: the server has ignored the earlier
    commands then (field note 20). A server that only was slow sends its replies one after the other.
    """

    command: Command


class FrameRejected(NamedTuple):
    """A data frame contradicts itself and is lost. Later frames are not affected.

    ``num_components`` is the number of components that it announces, which need not be true.
    """

    error: FrameError
    num_components: int


class UnexpectedPacket(NamedTuple):
    """A packet that answers no command: a duplicate or late reply, or a type that §4.2 does not define."""

    packet: Packet


class ByteOrderMismatch(NamedTuple):
    """The first frame makes sense only in ``byte_order``, which is not the one agreed (field note 4)."""

    byte_order: ByteOrder


class StreamCorrupted(NamedTuple):
    """A packet's size is out of bounds, so the next packet cannot be found; the state is CLOSED."""

    error: PacketError


ProtocolEvent = (
    Answered
    | Refused
    | PossibleReply
    | FrameRejected
    | FilePiece
    | UnexpectedPacket
    | ByteOrderMismatch
    | StreamCorrupted
)


class ClientProtocol:
    """The state of one connection. Use a new object for the next connection.

    ``send`` sends a command, ``receive`` takes the server's bytes, and ``bytes_to_send`` returns the bytes
    to write to the server. The packet type of a reply decides whether a command is accepted or refused,
    never its text (field note 1). ReplyMatcher decides which command a reply answers.
    """

    def __init__(
        self,
        max_packet_bytes: int = DEFAULT_MAX_PACKET_BYTES,
        max_c3d_bytes: int = DEFAULT_MAX_C3D_BYTES,
    ) -> None:
        self._packet_reader = PacketReader(max_packet_bytes, max_c3d_bytes)
        self._frame_reader: FrameReader | None = None  # None before the first frame that has a component
        self._replies = ReplyMatcher()
        self._agreed_byte_order: ByteOrder = "big"
        self._outgoing = b""
        self.state = ProtocolState.IDLE

    @property
    def byte_order(self) -> ByteOrder | None:
        """The byte order of the server's frames; None before the first frame that has a component."""
        return None if self._frame_reader is None else self._frame_reader.byte_order

    @property
    def pending_command(self) -> Command | None:
        """The command whose answer the client is waiting for."""
        return self._replies.pending

    def send(self, command: Command) -> None:
        """Send ``command``, which is then pending until it is answered.

        Raises ClosedError after Bye or the end of the connection, and LinkError while another command is
        pending; ``Bye`` is allowed then. ``give_up`` ends a command that is not answered.
        """
        self._check_open(str(command))
        if isinstance(command, Bye):
            self._apply(ProtocolInput.BYE_SENT)
        elif self.pending_command is not None:
            raise LinkError(f"{command} not sent: {self.pending_command} has not been answered yet")
        elif isinstance(command, StreamFrames):
            self._apply(ProtocolInput.REQUEST_SENT)
        self._replies.pending = command
        self._outgoing += encode_packet(PacketType.COMMAND, encode_command(command))

    def send_recording(self, *, start: bool) -> None:
        """Start or stop the server's recording as WaveFront's clients do (field note 16); no reply follows.

        Raises ClosedError after Bye or the end of the connection.
        """
        self._check_open("recording control")
        unused = _UNUSED_PARAMETER
        event = np.array([(int(start), 0, unused, unused, unused)], LONG_EVENT)
        component = encode_component(ComponentType.EVENT, -1, 0, event, self._agreed_byte_order)
        self._outgoing += encode_packet(PacketType.DATA, encode_frame([component], self._agreed_byte_order))

    def give_up(self) -> None:
        """Stop waiting for the pending command. A late reply to it answers no command."""
        if isinstance(self.pending_command, StopStreaming):
            self._apply(ProtocolInput.STOP_UNANSWERED)
        self._replies.give_up()

    def assume_reply(self) -> list[ProtocolEvent]:
        """Take the newest PossibleReply as the reply to the pending command; return the event, if any."""
        events: list[ProtocolEvent] = []
        packet = self._replies.possible
        if packet is not None:
            self._on_reply(packet, events)
        return events

    def bytes_to_send(self) -> bytes:
        """Return the bytes to write to the server since the last call."""
        data, self._outgoing = self._outgoing, b""
        return data

    def end(self) -> None:
        """Enter the state CLOSED, whichever side closed the connection."""
        self._apply(ProtocolInput.CONNECTION_ENDED)

    @property
    def has_more(self) -> bool:
        """Whether ``receive`` has not processed all bytes yet, because of ``max_packets``."""
        return self._packet_reader.has_more

    def receive(
        self, data: bytes, max_packets: int = ALL_PACKETS
    ) -> tuple[list[RawFrame], list[ProtocolEvent]]:
        """Take bytes from the server; return the frames and the other events that they complete.

        Processes at most ``max_packets``. While ``has_more``, call it again, with b"" or with the next bytes.
        Each list is in the order of arrival, but the order between frames and events is lost. Handle the
        events first, so that a ByteOrderMismatch is reported before the first frame is used. ``state`` is
        the state after all of them. StreamCorrupted is always the last event. Never raises.
        """
        frames: list[RawFrame] = []
        events: list[ProtocolEvent] = []
        for packet in self._packet_reader.feed(data, max_packets):
            if packet.type == DATA:
                self._on_data(packet, frames, events)
            else:
                self._on_packet(packet, events)
        error = self._packet_reader.error
        if error is not None and self.state is not ProtocolState.CLOSED:
            self.end()
            events.append(StreamCorrupted(error))
        return frames, events

    def _check_open(self, unsent: str) -> None:
        """Raise ClosedError, which names ``unsent``, after Bye or the end of the connection."""
        if self.state in {ProtocolState.CLOSING, ProtocolState.CLOSED}:
            raise ClosedError(f"{unsent} not sent: the connection is {self.state.value}")

    def _apply(self, protocol_input: ProtocolInput) -> None:
        states, after = _TRANSITIONS[protocol_input]
        if self.state in states:
            self.state = after

    def _on_data(self, packet: Packet, frames: list[RawFrame], events: list[ProtocolEvent]) -> None:
        reader = self._frame_reader
        try:
            if reader is not None:
                frame = reader.read(packet.body)
            else:
                frame = self._read_first_frame(packet.body, events)
        except FrameError as error:
            byte_order = self.byte_order or self._agreed_byte_order
            events.append(FrameRejected(error, announced_components(packet.body, byte_order)))
            return
        pending = self._replies.pending
        if pending is not None and self._is_answered_by(frame, pending):
            self._replies.finish_by_data()
            events.append(Answered(pending, packet))
        if self.state is not ProtocolState.STREAMING:
            if isinstance(pending, SendCurrentFrame):
                return  # No frames are streamed yet, so this one is only the answer.
            self._apply(ProtocolInput.FRAME_RECEIVED)
        frames.append(frame)

    def _read_first_frame(self, body: bytes, events: list[ProtocolEvent]) -> RawFrame:
        byte_order = detect_byte_order(body, self._agreed_byte_order)
        reader = FrameReader(byte_order)
        frame = reader.read(body)
        if frame.layout.fields:
            self._frame_reader = reader
            if byte_order != self._agreed_byte_order:
                events.append(ByteOrderMismatch(byte_order))
        return frame

    def _is_answered_by(self, frame: RawFrame, pending: Command) -> bool:
        match pending:
            case StreamFrames():
                # In other states frames arrive anyway, so they do not show that a new rate was accepted.
                return self.state is ProtocolState.REQUESTED
            case SendCurrentFrame() if self.state is not ProtocolState.STREAMING:
                return True
            case SendCurrentFrame(components=requested):
                received = {component.type for component in frame.layout.components}
                # A streamed frame that lacks all requested components is not the answer.
                return not requested or not received or not received.isdisjoint(requested)
            case _:
                return False

    def _on_packet(self, packet: Packet, events: list[ProtocolEvent]) -> None:
        pending = self._replies.pending
        match packet.type:
            case PacketType.COMMAND | PacketType.ERROR | PacketType.XML:
                match = self._replies.match(packet)
                if pending is None or match is Match.NO:
                    events.append(UnexpectedPacket(packet))
                elif match is Match.MAYBE:
                    events.append(PossibleReply(pending))
                else:
                    self._on_reply(packet, events)
            case PacketType.NO_DATA:
                if not isinstance(pending, SendCurrentFrame) or self.state is not ProtocolState.IDLE:
                    self._apply(ProtocolInput.NO_DATA_RECEIVED)
                if isinstance(pending, StreamFrames | SendCurrentFrame):
                    self._replies.finish_by_data()
                    events.append(Answered(pending, packet))
            case _:
                events.append(packet if isinstance(packet, FilePiece) else UnexpectedPacket(packet))

    def _on_reply(self, packet: Packet, events: list[ProtocolEvent]) -> None:
        """Process a text or XML that answers the pending command."""
        command = self._replies.pending
        if command is None:
            return
        self._replies.finish_by_reply()
        if packet.type == PacketType.ERROR:
            if isinstance(command, StreamFrames):
                self._apply(ProtocolInput.REQUEST_REFUSED)
            text = safe_text(decode_text(packet.body[:_MAX_ERROR_BYTES])) or "no reason given"
            events.append(Refused(command, ServerError(text)))
            return
        if isinstance(command, SetByteOrder):
            self._agreed_byte_order = command.byte_order
        elif isinstance(command, StopStreaming):
            self._apply(ProtocolInput.STOP_ACCEPTED)
        events.append(Answered(command, packet))
