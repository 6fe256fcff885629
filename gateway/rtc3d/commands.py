"""Command texts (§5): typed commands, built and parsed; the texts of acknowledgements."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from gateway.errors import CommandError
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.packets import decode_text
from gateway.rtc3d.parameters import SECTIONS

# "Event" is an alias that some clients use.
_COMPONENTS: Final = {component.command_word: component for component in WIRE_ORDER} | {
    "Event": ComponentType.EVENT
}
_SECTIONS: Final = {section.command_word: key for key, section in SECTIONS.items()} | {"Event": "events"}
_KNOWN_COMMANDS: Final = (
    "known are Version, SetByteOrder, SendParameters, SendCurrentFrame, StreamFrames, Bye"
)
_Name = TypeVar("_Name")
_NUMBER: Final = re.compile(r"\d{1,9}(\.\d{1,20})?", re.ASCII)
_MIN_HZ: Final = 1e-6  # the smallest that our own six decimals can write


@dataclass(frozen=True, slots=True)
class AllFrames:
    """Every real-time frame that the server processes."""

    def __str__(self) -> str:
        return "AllFrames"


@dataclass(frozen=True, slots=True)
class Frequency:
    """About ``hz`` frames per second."""

    hz: float

    def __str__(self) -> str:
        return f"Frequency:{self.hz:.6f}".rstrip("0").rstrip(".")


@dataclass(frozen=True, slots=True)
class FrequencyDivisor:
    """Every ``divisor``-th real-time frame."""

    divisor: int

    def __str__(self) -> str:
        return f"FrequencyDivisor:{self.divisor}"


Rate = AllFrames | Frequency | FrequencyDivisor


@dataclass(frozen=True, slots=True)
class Version:
    """§5.3.1. ``number`` is n.n; this protocol is 1.0."""

    number: str = "1.0"

    def __str__(self) -> str:
        return f"Version {self.number}"


@dataclass(frozen=True, slots=True)
class SetByteOrder:
    """§5.3.2: the byte order of data frames."""

    byte_order: ByteOrder

    def __str__(self) -> str:
        return f"SetByteOrder {self.byte_order.capitalize()}Endian"


@dataclass(frozen=True, slots=True)
class SendParameters:
    """§5.3.3. ``sections`` are keys of SECTIONS; none means all."""

    sections: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join(["SendParameters", *(SECTIONS[key].command_word for key in self.sections)])


@dataclass(frozen=True, slots=True)
class SendCurrentFrame:
    """§5.3.4. No components means all. NDI's client may name Events too (field note 14)."""

    components: tuple[ComponentType, ...] = ()

    def __str__(self) -> str:
        return " ".join(["SendCurrentFrame", *_component_words(self.components)])


@dataclass(frozen=True, slots=True)
class StreamFrames:
    """§5.3.5. No rate leaves it to the server, which is all frames; no components means all."""

    rate: Rate | None = None
    components: tuple[ComponentType, ...] = ()

    def __str__(self) -> str:
        rate = [] if self.rate is None else [str(self.rate)]
        return " ".join(["StreamFrames", *rate, *_component_words(self.components)])


@dataclass(frozen=True, slots=True)
class StopStreaming:
    """§5.3.5: StreamFrames Stop."""

    def __str__(self) -> str:
        return "StreamFrames Stop"


@dataclass(frozen=True, slots=True)
class Bye:
    """§5.3.6."""

    def __str__(self) -> str:
        return "Bye"


Command = Version | SetByteOrder | SendParameters | SendCurrentFrame | StreamFrames | StopStreaming | Bye


def _component_words(components: Iterable[ComponentType]) -> list[str]:
    # No components means All by §5.3.4 and §5.3.5; servers that know no component names accept the
    # bare command (field note 2), so it is left bare.
    return [component.command_word for component in components]


def encode_command(command: Command) -> bytes:
    """Return the body of the command's type-1 packet: ASCII, not NUL-terminated (§5.1)."""
    return str(command).encode("ascii")


def parse_command(body: bytes) -> Command:
    """Return the command in a type-1 packet's body.

    Case does not count; NUL, LF and white space at the end are dropped (§5.2, field note 13).
    Raises CommandError with a text for the client: what was wrong and what is accepted.
    """
    words = decode_text(body).split()
    if not words:
        raise CommandError(f"Empty command; {_KNOWN_COMMANDS}")
    verb, parameters = words[0].lower(), [word.lower() for word in words[1:]]
    match verb:
        case "version":
            return _parse_version(parameters)
        case "setbyteorder":
            return _parse_byte_order(parameters)
        case "sendparameters":
            return SendParameters(_parse_names(parameters, _SECTIONS, "section"))
        case "sendcurrentframe":
            return SendCurrentFrame(_parse_names(parameters, _COMPONENTS, "component"))
        case "streamframes":
            return _parse_stream_frames(parameters)
        case "bye" if not parameters:
            return Bye()
        case "bye":
            raise CommandError("Bye takes no parameter")
        case _:
            raise CommandError(f"Unknown command {_shown(words[0])}; {_KNOWN_COMMANDS}")


def _parse_version(parameters: Sequence[str]) -> Version:
    if len(parameters) != 1 or not re.fullmatch(r"\d{1,4}\.\d{1,4}", parameters[0], re.ASCII):
        raise CommandError("Version takes one parameter n.n, as in: Version 1.0")
    return Version(parameters[0])


def _parse_byte_order(parameters: Sequence[str]) -> SetByteOrder:
    match parameters:
        case ["bigendian"]:
            return SetByteOrder("big")
        case ["littleendian"]:
            return SetByteOrder("little")
    raise CommandError("SetByteOrder takes one parameter, BigEndian or LittleEndian")


def _parse_stream_frames(parameters: Sequence[str]) -> StreamFrames | StopStreaming:
    if parameters == ["stop"]:
        return StopStreaming()
    rate: Rate | None = None
    names = []
    for word in parameters:
        parsed = _parse_rate(word)
        if parsed is None:
            names.append(word)
        elif rate is None:
            rate = parsed
        else:
            raise CommandError("StreamFrames takes one of FrequencyDivisor:n, Frequency:n, AllFrames")
    others = ("FrequencyDivisor:n", "Frequency:n", "AllFrames", "Stop (alone)")
    return StreamFrames(rate, _parse_names(names, _COMPONENTS, "parameter", others))


def _parse_rate(word: str) -> Rate | None:
    """Return the rate in a lower-case parameter, None if it is no rate parameter at all."""
    if word == "allframes":
        return AllFrames()
    name, colon, value = word.partition(":")
    if not colon:
        return None
    number = float(value) if _NUMBER.fullmatch(value) else 0.0
    if name == "frequency" and number >= _MIN_HZ:
        return Frequency(number)
    if name == "frequencydivisor" and number >= 1 and number.is_integer():
        return FrequencyDivisor(int(number))
    raise CommandError(
        f"Unknown rate {_shown(word)}; known are FrequencyDivisor:n (n a whole number from 1), "
        "Frequency:n (n Hz, above 0), AllFrames"
    )


def _parse_names(
    words: Sequence[str], known: dict[str, _Name], what: str, others: Sequence[str] = ()
) -> tuple[_Name, ...]:
    """Return the named things, each once, in the order given; empty for All or nothing.

    ``others`` are what else the command takes, for the error's text.
    """
    by_word = {word.lower(): name for word, name in known.items()}
    names: dict[_Name, None] = {}
    for word in words:
        if word in by_word:
            names[by_word[word]] = None
        elif word != "all":
            accepted = ", ".join(["All", *known, *others])
            raise CommandError(f"Unknown {what} {_shown(word)}; known are {accepted}")
    return () if "all" in words else tuple(names)


def _shown(word: str) -> str:
    """Return a client's word fit for an error text: bounded, printable."""
    return repr(word if len(word) <= 40 else word[:40] + "…").encode("ascii", "replace").decode()
