"""Faults of the replies to commands: refused, doubled, missing, late, and worded otherwise."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument

import re
from typing import Annotated, ClassVar, Final, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field

from gateway.config.section import expects, join_or
from gateway.rtc3d.packets import HEADER, Packet, PacketType, encode_packet, text_of
from gateway.simulator.faults.base import Count, LineFault, Milliseconds, is_acknowledgement, type_of
from gateway.simulator.faults.line import Line

Verb = Literal["version", "setbyteorder", "sendparameters", "sendcurrentframe", "streamframes", "bye"]
VERBS: Final[tuple[Verb, ...]] = get_args(Verb)

_MINIMAL: Final = re.compile(r"streamframes( frequencydivisor:\S+| stop)?|sendcurrentframe")
_OK: Final = b"OK-"
_ERROR: Final = b"Error-"


def _not_empty(verbs: tuple[Verb, ...]) -> tuple[Verb, ...]:
    if not verbs:
        raise ValueError
    return verbs


Verbs = Annotated[
    tuple[Annotated[Verb, expects(join_or(VERBS))], ...],
    AfterValidator(_not_empty),
    BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
    expects("a command's first word in lower case, or a list of such"),
]
Copies = Annotated[int, Field(strict=True, ge=2, le=100), expects("a whole number from 2 to 100")]


def _verb(command: Packet) -> str:
    words = text_of(command.body).lower().split() if command.type == PacketType.COMMAND else []
    return words[0] if words else ""


class RefusedCommands(LineFault):
    """Commands are answered with an error packet, and not obeyed."""

    kind: ClassVar[str] = "refused_commands"

    commands: Verbs = ("version",)
    """Which."""

    def refusal(self, command: Packet) -> str | None:
        """See LineFault."""
        return f"{_verb(command)} is refused" if _verb(command) in self.commands else None


class MinimalServer(LineFault):
    """All is refused but bare StreamFrames, its FrequencyDivisor:n and Stop, and bare SendCurrentFrame.

    Field note 2.
    """

    kind: ClassVar[str] = "minimal_server"

    def refusal(self, command: Packet) -> str | None:
        """See LineFault."""
        text = " ".join(text_of(command.body).lower().split())
        if command.type != PacketType.COMMAND or _MINIMAL.fullmatch(text):
            return None
        return f"{_verb(command)} is not known in this form"


class _AcknowledgementFault(LineFault):
    """A fault of what says that a command succeeded."""

    commands: Verbs = VERBS
    """The replies to which commands."""

    def replies(self, command: Packet, replies: list[bytes], line: Line) -> list[bytes]:
        """See LineFault."""
        if _verb(command) not in self.commands:
            return replies
        changed: list[bytes] = []
        for reply in replies:
            changed += self.acknowledgements(reply, line) if is_acknowledgement(reply) else [reply]
        return changed

    def acknowledgements(self, reply: bytes, line: Line) -> list[bytes]:
        """Return what is sent at once instead of one acknowledgement."""
        raise NotImplementedError


class MissingAcknowledgements(_AcknowledgementFault):
    """Commands are obeyed, and not acknowledged."""

    kind: ClassVar[str] = "missing_acknowledgements"

    def acknowledgements(self, reply: bytes, line: Line) -> list[bytes]:
        """See _AcknowledgementFault."""
        return []


class DoubledAcknowledgements(_AcknowledgementFault):
    """Commands are acknowledged more than once.

    Field note 3.
    """

    kind: ClassVar[str] = "doubled_acknowledgements"

    copies: Copies = 2
    """How often."""

    def acknowledgements(self, reply: bytes, line: Line) -> list[bytes]:
        """See _AcknowledgementFault."""
        return [reply] * self.copies


class LateAcknowledgements(_AcknowledgementFault):
    """Acknowledgements come late; frames and other replies overtake them."""

    kind: ClassVar[str] = "late_acknowledgements"

    delay_ms: Milliseconds = 500.0
    """How late, in ms."""

    def acknowledgements(self, reply: bytes, line: Line) -> list[bytes]:
        """See _AcknowledgementFault."""
        line.hold_for(reply, self.delay_ms / 1000)
        return []


class FramesFirst(LineFault):
    """The first frames come before StreamFrames is acknowledged.

    Field note 3.
    """

    kind: ClassVar[str] = "frames_first"

    frames: Count = 3
    """How many; No Data ends the wait."""

    def replies(self, command: Packet, replies: list[bytes], line: Line) -> list[bytes]:
        """See LineFault."""
        if _verb(command) != "streamframes" or text_of(command.body).lower().endswith("stop"):
            return replies
        for reply in filter(is_acknowledgement, replies):
            line.hold_for_frames(reply, self.frames)
        return [reply for reply in replies if not is_acknowledgement(reply)]


class ReplyText(LineFault):
    """Replies are worded as by servers that are not NDI's, errors as err-….

    Field note 1.
    """

    kind: ClassVar[str] = "reply_text"

    form: Annotated[Literal["echo", "ok-verb"], expects("echo or ok-verb")] = "ok-verb"
    """echo is the command as it was sent, ok-verb the likes of ok-streamframes."""

    def replies(self, command: Packet, replies: list[bytes], line: Line) -> list[bytes]:
        """See LineFault."""
        echo = text_of(command.body) if self.form == "echo" else f"ok-{_verb(command)}"
        return [self._reworded(reply, echo) for reply in replies]

    @staticmethod
    def _reworded(reply: bytes, acknowledgement: str) -> bytes:
        text = reply[HEADER.size :]
        if is_acknowledgement(reply) and text.startswith(_OK):
            return encode_packet(PacketType.COMMAND, acknowledgement.encode("latin-1"))
        if type_of(reply) == PacketType.ERROR:
            return encode_packet(PacketType.ERROR, b"err-" + text.removeprefix(_ERROR))
        return reply


REPLY_FAULTS: Final[tuple[type[LineFault], ...]] = (
    RefusedCommands,
    MinimalServer,
    MissingAcknowledgements,
    DoubledAcknowledgements,
    LateAcknowledgements,
    FramesFirst,
    ReplyText,
)
