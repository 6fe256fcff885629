"""The client's side of one RTC3D connection, without I/O: bytes in, events and bytes out.

A reply carries no number that says which command it answers, so one command is under way at a time
and the connection keeps the list of those that are still owed a reply. The rules, all in this file:

- A reply is a success or a failure by its packet type, never by its text (field note 1).
- Only an answer of the right type ends a request: ``_ANSWERS``. An acknowledgement ahead of XML or of
  a frame (field note 3) is passed over.
- A reply whose text names another command than the one under way is a doubled or late one, and
  goes to nobody. A reply that names none goes to the oldest command that is owed one.
- A request given up (time-out) stays owed; once a later one is surely answered, it is no more,
  because a server answers in order.
"""

import re
from collections import deque
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from gateway.errors import ClosedError, FrameError, LinkError, PacketError, ParametersError, ServerError
from gateway.rtc3d.commands import (
    Bye,
    Command,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
    encode_command,
)
from gateway.rtc3d.components import LONG_EVENT, ByteOrder, ComponentType, build_component
from gateway.rtc3d.frame_reader import FrameReader
from gateway.rtc3d.frames import Frame, build_frame, byte_order_of, split_frame
from gateway.rtc3d.packets import (
    DEFAULT_MAX_C3D_BYTES,
    DEFAULT_MAX_PACKET_BYTES,
    Packet,
    PacketReader,
    PacketType,
    encode_packet,
    text_of,
)
from gateway.rtc3d.parameters import SECTIONS, sections_of
from gateway.rtc3d.parameters_xml import parse_parameters


class State(Enum):
    """What the server was asked for and what it last said of it."""

    IDLE = "idle"
    ASKED = "asked"  # StreamFrames was sent; neither a frame nor No Data came yet
    STREAMING = "streaming"
    NO_MEASUREMENT = "no measurement"
    CLOSING = "closing"  # Bye was sent
    CLOSED = "closed"


class Input(Enum):
    """What moves a connection from one state to another."""

    STREAM = "StreamFrames sent"
    REFUSED = "StreamFrames refused"
    STOP = "StreamFrames Stop sent"
    FRAME = "a frame came"
    NO_DATA = "No Data came"
    BYE = "Bye sent"
    END = "the connection ended"


_TRANSITIONS: Final[dict[tuple[State, Input], State]] = {
    (State.IDLE, Input.STREAM): State.ASKED,
    (State.ASKED, Input.REFUSED): State.IDLE,
    (State.ASKED, Input.FRAME): State.STREAMING,
    (State.ASKED, Input.NO_DATA): State.NO_MEASUREMENT,
    (State.STREAMING, Input.NO_DATA): State.NO_MEASUREMENT,
    (State.NO_MEASUREMENT, Input.FRAME): State.STREAMING,
    (State.ASKED, Input.STOP): State.IDLE,
    (State.STREAMING, Input.STOP): State.IDLE,
    (State.NO_MEASUREMENT, Input.STOP): State.IDLE,
    **{(state, Input.BYE): State.CLOSING for state in State if state is not State.CLOSED},
    **{(state, Input.END): State.CLOSED for state in State},
}
"""Every change of state; an input that is not here leaves the state as it is."""

_ANSWERS: Final[dict[type[Command], frozenset[PacketType]]] = {
    Version: frozenset({PacketType.COMMAND}),
    SetByteOrder: frozenset({PacketType.COMMAND}),
    SendParameters: frozenset({PacketType.XML}),
    SendCurrentFrame: frozenset({PacketType.DATA, PacketType.NO_DATA}),
    # A frame shows that StreamFrames was accepted; its acknowledgement may come later (field note 3).
    StreamFrames: frozenset({PacketType.COMMAND, PacketType.DATA, PacketType.NO_DATA}),
    StopStreaming: frozenset({PacketType.COMMAND}),
    Bye: frozenset({PacketType.COMMAND}),
}
"""The packet types that answer each command; an error packet answers any."""

_ACKNOWLEDGED: Final = re.compile(
    r"(?:ok\W*)?(version|setbyteorder|sendparameters|sendcurrentframe|streamframes|bye)\b"
)
"""The command that an acknowledgement's text begins with, as all known servers write it (field note 1)."""

_MAX_ERROR_BYTES: Final = 300  # of an error text: it goes into logs and every status message
_REMEMBERED: Final = 8
"""How many commands owed a reply, and how many just answered, are kept to know stray replies by."""


class Answered(NamedTuple):
    """The server answered ``command`` with ``packet``, of a type that _ANSWERS has."""

    command: Command
    packet: Packet


class Refused(NamedTuple):
    """The server answered ``command`` with an error packet."""

    command: Command
    error: ServerError


class FrameRejected(NamedTuple):
    """A data frame contradicts itself; it is lost, the next may be good."""

    error: FrameError


class FileReceived(NamedTuple):
    """A complete C3D file came (packet type 5)."""

    content: bytes


class Stray(NamedTuple):
    """A packet that nobody waits for: a doubled or late reply, or a type that §4.2 does not know."""

    packet: Packet


class OtherByteOrder(NamedTuple):
    """The first frame makes sense only in ``byte_order``, which is not the one agreed (field note 4)."""

    byte_order: ByteOrder


class Broken(NamedTuple):
    """The stream cannot be followed any further; the connection is closed."""

    error: PacketError


Event = Answered | Refused | FrameRejected | FileReceived | Stray | OtherByteOrder | Broken


class ClientProtocol:
    """One connection, from its first byte to its last; not to be used again.

    ``send`` puts a command under way and ``receive`` takes the server's bytes; what is to be sent is
    in ``bytes_to_send``.
    """

    def __init__(
        self,
        max_packet_bytes: int = DEFAULT_MAX_PACKET_BYTES,
        max_c3d_bytes: int = DEFAULT_MAX_C3D_BYTES,
    ) -> None:
        self._packet_reader = PacketReader(max_packet_bytes, max_c3d_bytes)
        self._frame_reader: FrameReader | None = None  # before the first frame that has a component
        self._outgoing = bytearray()
        self._agreed_order: ByteOrder = "big"
        self._owed: deque[Command] = deque(maxlen=_REMEMBERED)
        self._answered: deque[Command] = deque(maxlen=_REMEMBERED)
        self.state = State.IDLE
        self.under_way: Command | None = None
        """The command whose answer is awaited."""

    @property
    def byte_order(self) -> ByteOrder | None:
        """The byte order of the server's frames; None before the first frame that has a component."""
        return None if self._frame_reader is None else self._frame_reader.byte_order

    def send(self, command: Command) -> None:
        """Put ``command`` under way.

        Raises ClosedError after the end, and LinkError while another command is under way: its answer
        must come, or be given up, first. ``Bye`` may be sent at any time.
        """
        if self.state in {State.CLOSING, State.CLOSED}:
            raise ClosedError(f"{command} not sent: the connection is {self.state.value}")
        if isinstance(command, Bye):
            self._move(Input.BYE)
        elif self.under_way is not None:
            raise LinkError(f"{command} not sent: the answer to {self.under_way} is still awaited")
        elif isinstance(command, StreamFrames):
            self._move(Input.STREAM)
        elif isinstance(command, StopStreaming):
            self._move(Input.STOP)
        self.under_way = command
        self._outgoing += encode_packet(PacketType.COMMAND, encode_command(command))

    def send_recording(self, *, start: bool) -> None:
        """Start or stop the server's recording as WaveFront's clients do (field note 16); no reply comes.

        Raises ClosedError after the end.
        """
        if self.state in {State.CLOSING, State.CLOSED}:
            raise ClosedError(f"recording control not sent: the connection is {self.state.value}")
        unused = -1
        event = np.array([(int(start), 0, unused, unused, unused)], LONG_EVENT)
        component = build_component(ComponentType.EVENT, -1, 0, event, self._agreed_order)
        self._outgoing += encode_packet(PacketType.DATA, build_frame([component], self._agreed_order))

    def give_up(self) -> None:
        """Wait no longer for the command under way; should its reply come later, it goes to nobody."""
        if self.under_way is not None:
            self._owed.append(self.under_way)
            self.under_way = None

    def bytes_to_send(self) -> bytes:
        """Return what is to be written to the server, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def end(self) -> None:
        """Note that the connection ended, from whichever side."""
        self._move(Input.END)

    def receive(self, data: bytes) -> tuple[list[Frame], list[Event]]:
        """Take bytes from the server; return the frames and all other events that they complete.

        Both lists are in the order of arrival. Frames and events that came in one read are not ordered
        against each other; handle the events first. ``Broken`` is always the last event. Never raises.
        """
        frames: list[Frame] = []
        events: list[Event] = []
        for packet in self._packet_reader.feed(data):
            if packet.type == PacketType.DATA:
                self._on_data(packet, frames, events)
            else:
                self._on_packet(packet, events)
        error = self._packet_reader.error
        if error is not None and self.state is not State.CLOSED:
            self.end()
            events.append(Broken(error))
        return frames, events

    def _move(self, reason: Input) -> None:
        self.state = _TRANSITIONS.get((self.state, reason), self.state)

    def _on_data(self, packet: Packet, frames: list[Frame], events: list[Event]) -> None:
        try:
            frame = self._read_frame(packet.body, events)
        except FrameError as error:
            events.append(FrameRejected(error))
            return
        if self.under_way is not None:
            if isinstance(self.under_way, SendCurrentFrame) and self.state is not State.STREAMING:
                # Nothing streams, so it is the answer and nothing else.
                self._answer(packet, events)
                return
            self._answer_with_frame(packet, frame, events)
        if self.state is not State.STREAMING:
            self._move(Input.FRAME)
        frames.append(frame)

    def _read_frame(self, body: bytes, events: list[Event]) -> Frame:
        if self._frame_reader is not None:
            return self._frame_reader.read(body)
        byte_order = byte_order_of(body, self._agreed_order)
        frame = split_frame(body, byte_order)
        if frame.layout.parts or frame.unknown_types:
            self._frame_reader = FrameReader(byte_order)
            if byte_order != self._agreed_order:
                events.append(OtherByteOrder(byte_order))
        return frame

    def _answer_with_frame(self, packet: Packet, frame: Frame, events: list[Event]) -> None:
        match self.under_way:
            case StreamFrames() if self.state is State.ASKED:
                self._owed.append(self.under_way)  # its acknowledgement
                self._answer(packet, events)
            case SendCurrentFrame(components=wanted):
                present = {part.type for part in frame.layout.parts}
                # A streamed frame without what was asked for is not the answer to it.
                if not wanted or not present or present.intersection(wanted):
                    self._answer(packet, events)
            case _:
                pass

    def _on_packet(self, packet: Packet, events: list[Event]) -> None:
        match packet.type:
            case PacketType.COMMAND | PacketType.ERROR:
                self._on_text(packet, events)
            case PacketType.XML:
                self._on_xml(packet, events)
            case PacketType.NO_DATA:
                self._move(Input.NO_DATA)
                if isinstance(self.under_way, StreamFrames):
                    self._owed.append(self.under_way)
                if isinstance(self.under_way, StreamFrames | SendCurrentFrame):
                    self._answer(packet, events)
            case PacketType.C3D:
                events.append(FileReceived(packet.body))
            case _:
                events.append(Stray(packet))

    def _on_text(self, packet: Packet, events: list[Event]) -> None:
        command = self._command_meant(packet)
        if command is None or command is not self.under_way:
            if command is not None and command in self._owed:
                self._owed.remove(command)
            events.append(Stray(packet))
        elif packet.type == PacketType.ERROR:
            self.under_way = None
            self._settle(command)
            self._answered.append(command)
            if isinstance(command, StreamFrames):
                self._move(Input.REFUSED)
            events.append(
                Refused(command, ServerError(text_of(packet.body[:_MAX_ERROR_BYTES]) or "no reason given"))
            )
        elif PacketType.COMMAND in _ANSWERS[type(command)]:
            self._settle(command)
            if isinstance(command, SetByteOrder):
                self._agreed_order = command.byte_order
            self._answer(packet, events)

    def _command_meant(self, packet: Packet) -> Command | None:
        """Return the command that a type 0 or 1 packet answers: under way, owed, answered, or None."""
        text = text_of(packet.body).lower()
        asked = [] if self.under_way is None else [self.under_way]
        # The text of one command may begin another's: the longest that is echoed is meant.
        echoed = [
            command for command in (*asked, *self._owed, *self._answered) if str(command).lower() in text
        ]
        if echoed:
            return max(echoed, key=lambda command: len(str(command)))
        named = _ACKNOWLEDGED.match(text) if packet.type == PacketType.COMMAND else None
        for command in (*self._owed, *asked):
            if named and named[1] != str(command).split()[0].lower():
                continue
            if packet.type == PacketType.ERROR or packet.type in _ANSWERS[type(command)]:
                return command
        return None

    def _on_xml(self, packet: Packet, events: list[Event]) -> None:
        meant = self._parameters_meant(packet)
        if meant is not None and meant is self.under_way:
            self._settle(meant)
            self._answer(packet, events)
            return
        if meant is not None and meant in self._owed:
            self._owed.remove(meant)
        events.append(Stray(packet))

    def _parameters_meant(self, packet: Packet) -> Command | None:
        """Return the SendParameters that the XML answers: under way, owed, answered, or None."""
        asked = [self.under_way] if isinstance(self.under_way, SendParameters) else []
        owed = [late for late in self._owed if isinstance(late, SendParameters) and late not in asked]
        if not owed:
            # Whatever it holds: a server may know no sections and send all of them, or leave some out.
            return asked[0] if asked else None
        present = _sections_in(packet.body)
        return max((*owed, *asked), key=lambda command: _fit(present, command))

    def _settle(self, command: Command) -> None:
        """Expect no reply to earlier commands any more, because a server answers in order.

        Unless one of them was the same: then this reply may be that one's, and another may follow.
        """
        if command not in self._owed:
            self._owed.clear()

    def _answer(self, packet: Packet, events: list[Event]) -> None:
        """End the command under way with ``packet``."""
        if self.under_way is not None:
            self._answered.append(self.under_way)
            events.append(Answered(self.under_way, packet))
            self.under_way = None


def _sections_in(xml: bytes) -> frozenset[str]:
    try:
        return sections_of(parse_parameters(xml).parameters)
    except ParametersError:
        return frozenset()


def _fit(present: frozenset[str], command: SendParameters) -> int:
    """Return how well the sections that came fit those asked for: 2 exactly, 1 some are left out, 0 not.

    Servers leave out sections that they do not have (field note 9).
    """
    asked = frozenset(command.sections or SECTIONS)
    return 2 if present == asked else int(present < asked)
