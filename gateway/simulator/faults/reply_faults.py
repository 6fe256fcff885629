"""Faults of the replies to commands: refusals, and missing, doubled, late or differently worded replies."""

import asyncio

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field

from gateway.config.section import expects
from gateway.config.words import join_or
from gateway.rtc3d.packets import PACKET_HEADER, Packet, PacketType, decode_text, encode_packet
from gateway.simulator.faults.base import (
    Count,
    LastingConnectionFault,
    Milliseconds,
    Reply,
    is_acknowledgement,
    packet_type_of,
)


@dataclass(slots=True, eq=False)
class _HeldReply:
    packet: bytes
    num_frames: int  # data frames to send before it; 0 if it waits for its timer
    timer: asyncio.TimerHandle | None = None


class HeldReplies:
    """Holds replies until their delay is over or enough frames have been sent, then sends them."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._held: list[_HeldReply] = []

    @property
    def waiting_bytes(self) -> int:
        """The size of all replies that are held."""
        return sum(len(held.packet) for held in self._held)

    def hold(self, reply: Reply) -> None:
        """Hold a reply for its ``delay_s`` or its ``after_frames``."""
        held = _HeldReply(reply.packet, reply.after_frames)
        if not reply.after_frames:
            held.timer = asyncio.get_running_loop().call_later(reply.delay_s, self._release, held)
        self._held.append(held)

    def packet_sent(self, packet: bytes) -> None:
        """Send the replies that waited for this packet, if it is a data frame or No Data."""
        packet_type = packet_type_of(packet)
        if not self._held or packet_type not in {PacketType.DATA, PacketType.NO_DATA}:
            return
        for held in [held for held in self._held if held.num_frames]:
            if held.num_frames > 1 and packet_type == PacketType.DATA:
                held.num_frames -= 1
            else:
                self._release(held)

    def flush(self) -> None:
        """Send all replies at once, in the order of their commands."""
        for held in list(self._held):
            self._release(held)

    def clear(self) -> None:
        """Discard all replies."""
        for held in self._held:
            if held.timer is not None:
                held.timer.cancel()
        self._held.clear()

    def _release(self, held: _HeldReply) -> None:
        if held not in self._held:
            return  # sending another reply has already released it
        self._held.remove(held)
        if held.timer is not None:
            held.timer.cancel()
        self._send(held.packet)


CommandName = Literal["version", "setbyteorder", "sendparameters", "sendcurrentframe", "streamframes", "bye"]
COMMAND_NAMES: Final[tuple[CommandName, ...]] = get_args(CommandName)

_MINIMAL: Final = re.compile(r"streamframes( frequencydivisor:\S+| stop)?|sendcurrentframe")
_OK: Final = b"OK-"
_ERROR: Final = b"Error-"


def _not_empty(names: tuple[CommandName, ...]) -> tuple[CommandName, ...]:
    if not names:
        raise ValueError
    return names


CommandNames = Annotated[
    tuple[Annotated[CommandName, expects(join_or(COMMAND_NAMES))], ...],
    AfterValidator(_not_empty),
    BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
    expects("the first word of a command in lower case, or a list of them"),
]
Copies = Annotated[int, Field(strict=True, ge=2, le=100), expects("a whole number from 2 to 100")]


def _command_name(command: Packet) -> str:
    """Return the first word of a command in lower case; "" for other packets."""
    words = decode_text(command.body).lower().split() if command.type == PacketType.COMMAND else []
    return words[0] if words else ""


class RefusedCommands(LastingConnectionFault):
    """The server answers commands with an error packet and does not execute them."""

    kind: ClassVar[str] = "refused_commands"

    commands: CommandNames = ("version",)
    """The commands that the server refuses."""

    def refusal(self, command: Packet) -> str | None:
        """See LastingConnectionFault."""
        name = _command_name(command)
        return f"{name} is refused" if name in self.commands else None


class MinimalServer(LastingConnectionFault):
    """The server accepts only SendCurrentFrame, and StreamFrames alone, with Stop or FrequencyDivisor:n.

    Field note 2.
    """

    kind: ClassVar[str] = "minimal_server"

    def refusal(self, command: Packet) -> str | None:
        """See LastingConnectionFault."""
        text = " ".join(decode_text(command.body).lower().split())
        if command.type != PacketType.COMMAND or _MINIMAL.fullmatch(text):
            return None
        return f"{_command_name(command)} is not known in this form"


class _AcknowledgementFault(LastingConnectionFault):
    """A fault of acknowledgements, the replies that report success."""

    commands: CommandNames = COMMAND_NAMES
    """The commands whose acknowledgements change."""

    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        """See LastingConnectionFault."""
        if _command_name(command) not in self.commands:
            return replies
        changed: list[Reply] = []
        for reply in replies:
            changed += self.change_acknowledgement(reply) if is_acknowledgement(reply.packet) else [reply]
        return changed

    def change_acknowledgement(self, reply: Reply) -> list[Reply]:
        """Return the replies to send instead of one acknowledgement."""
        raise NotImplementedError


class MissingAcknowledgements(_AcknowledgementFault):
    """The server executes commands but does not acknowledge them."""

    kind: ClassVar[str] = "missing_acknowledgements"

    def change_acknowledgement(self, reply: Reply) -> list[Reply]:
        """See _AcknowledgementFault."""
        return []


class DoubledAcknowledgements(_AcknowledgementFault):
    """The server acknowledges commands more than once.

    Field note 3.
    """

    kind: ClassVar[str] = "doubled_acknowledgements"

    copies: Copies = 2
    """The number of acknowledgements."""

    def change_acknowledgement(self, reply: Reply) -> list[Reply]:
        """See _AcknowledgementFault."""
        return [reply] * self.copies


class LateAcknowledgements(_AcknowledgementFault):
    """The server acknowledges commands late; frames and other replies overtake the acknowledgement."""

    kind: ClassVar[str] = "late_acknowledgements"

    delay_ms: Milliseconds = 500.0
    """The delay in milliseconds."""

    def change_acknowledgement(self, reply: Reply) -> list[Reply]:
        """See _AcknowledgementFault."""
        return [reply._replace(delay_s=self.delay_ms / 1000)]


class FramesFirst(LastingConnectionFault):
    """The server sends the first frames before it acknowledges StreamFrames.

    Field note 3.
    """

    kind: ClassVar[str] = "frames_first"

    frames: Count = 3
    """The number of frames before the acknowledgement; a No Data packet also ends the wait."""

    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        """See LastingConnectionFault."""
        if _command_name(command) != "streamframes" or decode_text(command.body).lower().endswith("stop"):
            return replies
        return [
            reply._replace(after_frames=self.frames) if is_acknowledgement(reply.packet) else reply
            for reply in replies
        ]


class ReplyText(LastingConnectionFault):
    """Replies have the wording of servers other than NDI's; errors begin with err-.

    Field note 1.
    """

    kind: ClassVar[str] = "reply_text"

    form: Annotated[Literal["echo", "ok-verb"], expects("echo or ok-verb")] = "ok-verb"
    """echo: the command as it was sent; ok-verb: a text such as ok-streamframes."""

    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        """See LastingConnectionFault."""
        text = decode_text(command.body) if self.form == "echo" else f"ok-{_command_name(command)}"
        return [reply._replace(packet=self._reworded(reply.packet, text)) for reply in replies]

    @staticmethod
    def _reworded(packet: bytes, acknowledgement: str) -> bytes:
        text = packet[PACKET_HEADER.size :]
        if is_acknowledgement(packet) and text.startswith(_OK):
            return encode_packet(PacketType.COMMAND, acknowledgement.encode("latin-1"))
        if packet_type_of(packet) == PacketType.ERROR:
            return encode_packet(PacketType.ERROR, b"err-" + text.removeprefix(_ERROR))
        return packet


REPLY_FAULTS: Final[tuple[type[LastingConnectionFault], ...]] = (
    RefusedCommands,
    MinimalServer,
    MissingAcknowledgements,
    DoubledAcknowledgements,
    LateAcknowledgements,
    FramesFirst,
    ReplyText,
)
