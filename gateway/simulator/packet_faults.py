"""Faults of packets: of the replies to commands, and of the values and sizes in data frames (§7)."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import contextlib
import math
import re
import struct
from typing import Annotated, Final, Literal, NamedTuple, get_args

import numpy as np
from pydantic import BeforeValidator, Field
from typing_extensions import override

from gateway.config.section import expects
from gateway.config.words import join_or
from gateway.errors import FrameError
from gateway.rtc3d.components import (
    MISSING,
    MISSING_MARKER,
    SHORT_EVENT,
    ByteOrder,
    ComponentType,
    Items,
    encode_component,
)
from gateway.rtc3d.frames import detect_byte_order, encode_frame, split_frame
from gateway.rtc3d.packets import PACKET_HEADER, Packet, PacketType, decode_text, encode_packet
from gateway.simulator.faults import (
    ActiveFault,
    Count,
    LastingConnectionFault,
    Milliseconds,
    PendingWrite,
    Reply,
    packet_type_of,
)

CommandName = Literal["version", "setbyteorder", "sendparameters", "sendcurrentframe", "streamframes", "bye"]
COMMAND_NAMES: Final[tuple[CommandName, ...]] = get_args(CommandName)

_MINIMAL: Final = re.compile(r"streamframes( frequencydivisor:\S+| stop)?|sendcurrentframe")

CommandNames = Annotated[
    tuple[Annotated[CommandName, expects(join_or(COMMAND_NAMES))], ...],
    Field(min_length=1),
    BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
    expects("the first word of a command in lower case, or a list of them"),
]
Copies = Annotated[int, Field(strict=True, ge=2, le=100), expects("a whole number from 2 to 100")]


def _command_name(command: Packet) -> str:
    """Return the first word of a command in lower case; "" for other packets."""
    words = decode_text(command.body).lower().split() if command.type == PacketType.COMMAND else []
    return words[0] if words else ""


def _is_acknowledgement(packet: bytes) -> bool:
    """Return whether a reply reports success: type 1, whatever its text (field note 1)."""
    return packet_type_of(packet) == PacketType.COMMAND


class RefusedCommands(LastingConnectionFault):
    """The server answers commands with an error packet and does not execute them."""

    commands: CommandNames = ("version",)
    """The commands that the server refuses."""

    @override
    def refusal(self, command: Packet) -> str | None:
        name = _command_name(command)
        return f"{name} is refused" if name in self.commands else None


class MinimalServer(LastingConnectionFault):
    """The server accepts only SendCurrentFrame, and StreamFrames alone, with Stop or FrequencyDivisor:n.

    Field note 2.
    """

    @override
    def refusal(self, command: Packet) -> str | None:
        text = " ".join(decode_text(command.body).lower().split())
        if command.type != PacketType.COMMAND or _MINIMAL.fullmatch(text):
            return None
        return f"{_command_name(command)} is not known in this form"


class _AcknowledgementFault(LastingConnectionFault):
    """A fault of acknowledgements, the replies that report success."""

    commands: CommandNames = COMMAND_NAMES
    """The commands whose acknowledgements change."""

    @override
    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        if _command_name(command) not in self.commands:
            return replies
        changed: list[Reply] = []
        for reply in replies:
            changed += self.acknowledgements(reply) if _is_acknowledgement(reply.packet) else [reply]
        return changed

    def acknowledgements(self, reply: Reply) -> list[Reply]:
        """Return the replies to send instead of one acknowledgement."""
        raise NotImplementedError


class MissingAcknowledgements(_AcknowledgementFault):
    """The server executes commands but does not acknowledge them."""

    @override
    def acknowledgements(self, reply: Reply) -> list[Reply]:
        return []


class DoubledAcknowledgements(_AcknowledgementFault):
    """The server acknowledges commands more than once.

    Field note 3.
    """

    copies: Copies = 2
    """The number of acknowledgements."""

    @override
    def acknowledgements(self, reply: Reply) -> list[Reply]:
        return [reply] * self.copies


class LateAcknowledgements(_AcknowledgementFault):
    """The server acknowledges commands late; frames and other replies overtake the acknowledgement."""

    delay_ms: Milliseconds = 500.0
    """The delay in milliseconds."""

    @override
    def acknowledgements(self, reply: Reply) -> list[Reply]:
        return [reply._replace(delay_s=self.delay_ms / 1000)]


class FramesFirst(LastingConnectionFault):
    """The server sends the first frames before it acknowledges StreamFrames.

    Field note 3.
    """

    frames: Count = 3
    """The number of frames before the acknowledgement; a No Data packet also ends the wait."""

    @override
    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        if _command_name(command) != "streamframes" or decode_text(command.body).lower().endswith("stop"):
            return replies
        return [
            reply._replace(after_frames=self.frames) if _is_acknowledgement(reply.packet) else reply
            for reply in replies
        ]


class ReplyText(LastingConnectionFault):
    """Replies have the wording of servers other than NDI's; errors begin with err-.

    Field note 1.
    """

    form: Annotated[Literal["echo", "ok-verb"], expects("echo or ok-verb")] = "ok-verb"
    """echo: the command as it was sent; ok-verb: a text such as ok-streamframes."""

    @override
    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        acknowledgement = decode_text(command.body) if self.form == "echo" else f"ok-{_command_name(command)}"
        changed = []
        for reply in replies:
            text = reply.packet[PACKET_HEADER.size :]
            packet = reply.packet
            if _is_acknowledgement(packet) and text.startswith(b"OK-"):
                packet = encode_packet(PacketType.COMMAND, acknowledgement.encode("latin-1"))
            elif packet_type_of(packet) == PacketType.ERROR:
                packet = encode_packet(PacketType.ERROR, b"err-" + text.removeprefix(b"Error-"))
            changed.append(reply._replace(packet=packet))
        return changed


Fraction = Annotated[
    float, Field(strict=True, ge=0, le=1, allow_inf_nan=False), expects("a number from 0 to 1")
]
Jump = Annotated[
    float,
    Field(strict=True, ge=-1e12, le=1e12, allow_inf_nan=False),
    expects("a number of milliseconds from -1e12 to 1e12"),
]
FrameNumber = Annotated[
    int, Field(strict=True, ge=-(2**31), lt=2**31), expects("a signed 32-bit whole number")
]
UnknownType = Annotated[
    int, Field(strict=True, ge=6, le=0xFFFFFFFF), expects("a whole number from 6 to 4294967295")
]
DataBytes = Annotated[int, Field(strict=True, ge=0, le=65536), expects("a whole number from 0 to 65536")]

_COUNT: Final[dict[ByteOrder, struct.Struct]] = {"big": struct.Struct(">I"), "little": struct.Struct("<I")}
_WRONG_BY: Final = 1000
_OFFSETS: Final = {"components": 0, "size": 4, "items": 24}
"""Offsets in a frame's body: of the number of components, and of the first one's size and number of items."""


class Values(NamedTuple):
    """The arguments of ``encode_component``."""

    type: ComponentType
    frame_number: int
    timestamp_us: int
    items: Items
    byte_order: ByteOrder


class FrameFault(LastingConnectionFault):
    """A fault of data frames. It leaves other packets, and frames damaged by another fault, unchanged."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        changed = []
        for write in writes:
            packet = write.data
            if packet_type_of(packet) == PacketType.DATA:
                body = packet[PACKET_HEADER.size :]
                with contextlib.suppress(FrameError):
                    frame = self.change_frame(body, detect_byte_order(body, "big"), active)
                    packet = encode_packet(PacketType.DATA, frame)
            changed.append(write._replace(data=packet))
        return changed

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """Return the body to send instead of ``body``: with a change to each component, unless overridden."""
        components = [
            self.change(
                Values(each.type, each.frame_number, each.timestamp_us, each.items(), byte_order), active
            )
            for each in split_frame(body, byte_order).components
        ]
        new_byte_order = components[0].byte_order if components else byte_order
        return encode_frame([encode_component(*each) for each in components], new_byte_order)

    def change(self, component: Values, active: ActiveFault) -> Values:
        """Return the component to send instead of ``component``."""
        return component


class Occlusion(FrameFault):
    """Markers and tools are out of view."""

    markers: Fraction = 1.0
    """The fraction of the markers that is out of view; other markers each time the fault begins."""

    tools: Fraction = 1.0
    """The fraction of the tools that is out of view."""

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        items = component.items.copy()
        order = np.random.default_rng(active.variant).permutation(len(items))
        if component.type is ComponentType.MARKERS:
            items[order[: math.ceil(self.markers * len(items))]] = MISSING_MARKER
        elif component.type is ComponentType.TOOLS:
            items[order[: math.ceil(self.tools * len(items))]] = (MISSING,) * 8
        return component._replace(items=items)


class FrozenTimestamps(FrameFault):
    """Time stamps keep the value that they have when the fault begins."""

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        if active.timestamp_us is None:
            active.timestamp_us = component.timestamp_us
        return component._replace(timestamp_us=active.timestamp_us)


class JumpingTimestamps(FrameFault):
    """Time stamps jump, and jump back when the fault ends."""

    jump_ms: Jump = -5000.0
    """The jump in milliseconds; a negative value jumps into the past."""

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        return component._replace(timestamp_us=component.timestamp_us + round(self.jump_ms * 1000))


class ConstantFrameNumbers(FrameFault):
    """Every frame has the same number.

    Field note 11.
    """

    frame_number: FrameNumber = 0
    """The frame number."""

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        return component._replace(frame_number=self.frame_number)


class ShortEvents(FrameFault):
    """Events have 16 bytes as in §7.7, instead of NDI's 24.

    Field note 6.
    """

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        if component.type is not ComponentType.EVENT:
            return component
        return component._replace(items=component.items[list(SHORT_EVENT.names or ())].astype(SHORT_EVENT))


class WrongByteOrder(FrameFault):
    """Frames have a different byte order than the server acknowledged.

    Field note 4.
    """

    byte_order: Annotated[Literal["big", "little", "other"], expects("big, little or other")] = "other"
    """big or little: always this byte order; other: the one that the client did not request."""

    @override
    def change(self, component: Values, active: ActiveFault) -> Values:
        if self.byte_order != "other":
            return component._replace(byte_order=self.byte_order)
        return component._replace(byte_order="little" if component.byte_order == "big" else "big")


class UnknownComponent(FrameFault):
    """Frames have an additional component of a type that §7.2 does not define."""

    component_type: UnknownType = 77
    """The type of the component."""

    data_bytes: DataBytes = 32
    """The size of its data in bytes, all zeros."""

    @override
    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        header = struct.Struct("<IIiq" if byte_order == "little" else ">IIiq")
        (count,) = _COUNT[byte_order].unpack_from(body)
        component = header.pack(header.size + self.data_bytes, self.component_type, 0, 0)
        return _COUNT[byte_order].pack(count + 1) + body[4:] + component + bytes(self.data_bytes)


class WrongCounts(FrameFault):
    """The sizes and counts in a frame contradict each other."""

    field: Annotated[Literal["components", "size", "items"], expects("components, size or items")] = "items"
    """The field that is 1000 too large: the number of components, or the first component's size or items."""

    @override
    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        damaged = bytearray(body)
        (count,) = _COUNT[byte_order].unpack_from(damaged, _OFFSETS[self.field])
        _COUNT[byte_order].pack_into(damaged, _OFFSETS[self.field], (count + _WRONG_BY) % 2**32)
        return bytes(damaged)


PACKET_FAULTS: Final = (
    *(RefusedCommands, MinimalServer, MissingAcknowledgements, DoubledAcknowledgements),
    *(LateAcknowledgements, FramesFirst, ReplyText),
    *(Occlusion, FrozenTimestamps, JumpingTimestamps, ConstantFrameNumbers, ShortEvents, WrongByteOrder),
    *(UnknownComponent, WrongCounts),
)
