"""Commands (§5) as typed objects: encoding them as text, and parsing them."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from gateway.errors import CommandError
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.packets import decode_text
from gateway.rtc3d.parameters import SECTIONS
from gateway.runtime.safe_text import quoted

# "Event" is an alias that some clients use.
_COMPONENT_BY_WORD: Final = {component.command_word: component for component in WIRE_ORDER} | {
    "Event": ComponentType.EVENT
}
_SECTION_BY_WORD: Final = {section.command_word: key for key, section in SECTIONS.items()} | {
    "Event": "events"
}
_KNOWN_COMMANDS: Final = (
    "known are Version, SetByteOrder, SendParameters, SendCurrentFrame, StreamFrames, Bye"
)
_USAGE: Final = {
    "version": "Version takes one parameter n.n, as in: Version 1.0",
    "setbyteorder": "SetByteOrder takes one parameter, BigEndian or LittleEndian",
    "bye": "Bye takes no parameter",
}
_Named = TypeVar("_Named")
_NUMBER: Final = re.compile(r"\d{1,9}(\.\d{1,20})?", re.ASCII)
_OPTION: Final = re.compile(r"([a-z]+) *= *([^,]*)", re.IGNORECASE | re.ASCII)
_UNITS_S: Final = {"seconds": 1, "minutes": 60, "hours": 3600}
_MIN_HZ: Final = 1e-6  # the lowest frequency that str(Frequency), with six decimals, can represent


@dataclass(frozen=True, slots=True)
class AllFrames:
    """A rate: every real-time frame that the server processes."""

    def __str__(self) -> str:
        return "AllFrames"


@dataclass(frozen=True, slots=True)
class Frequency:
    """A rate: about ``hz`` frames per second."""

    hz: float

    def __str__(self) -> str:
        return f"Frequency:{self.hz:.6f}".rstrip("0").rstrip(".")


@dataclass(frozen=True, slots=True)
class FrequencyDivisor:
    """A rate: every ``divisor``-th real-time frame that the server processes."""

    divisor: int

    def __str__(self) -> str:
        return f"FrequencyDivisor:{self.divisor}"


Rate = AllFrames | Frequency | FrequencyDivisor


@dataclass(frozen=True, slots=True)
class Version:
    """§5.3.1. ``number`` has the form n.n; the version of this protocol is 1.0."""

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
    """§5.3.3. ``sections`` are keys of SECTIONS; () means all."""

    sections: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join(["SendParameters", *(SECTIONS[key].command_word for key in self.sections)])


@dataclass(frozen=True, slots=True)
class SendCurrentFrame:
    """§5.3.4. () as components means all. NDI's client may request Events, too (field note 14)."""

    components: tuple[ComponentType, ...] = ()

    def __str__(self) -> str:
        return " ".join(["SendCurrentFrame", *_component_words(self.components)])


@dataclass(frozen=True, slots=True)
class StreamFrames:
    """§5.3.5. None as rate means the server's default, () as components means all."""

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
    """§5.3.6: the client disconnects."""

    def __str__(self) -> str:
        return "Bye"


@dataclass(frozen=True, slots=True)
class ControlRecording:
    """Start or stop a recording, as one WaveFront client does (field note 18); not in the specification."""

    start: bool
    options: str = ""
    """What follows Start, for example ",file=take1,duration=5,durationunits=seconds" (field note 26)."""

    def __str__(self) -> str:
        return f"Recording Start{self.options}" if self.start else "Recording Stop"


Command = (
    Version
    | SetByteOrder
    | SendParameters
    | SendCurrentFrame
    | StreamFrames
    | StopStreaming
    | Bye
    | ControlRecording
)


def _component_words(components: Iterable[ComponentType]) -> list[str]:
    # No components means All (§5.3.4, §5.3.5). "All" itself is not sent, because servers that know no
    # component names accept only the bare command (field note 2).
    return [component.command_word for component in components]


def encode_command(command: Command) -> bytes:
    """Return the body of the command's type-1 packet: ASCII, not NUL-terminated (§5.1)."""
    return str(command).encode("ascii")


def parse_command(body: bytes) -> Command:
    """Return the command in a type-1 packet's body.

    Ignores case, and NUL, LF and white space at the end (§5.2, field note 13). Raises CommandError, whose
    text says what is wrong and what is accepted; the server can send it to the client.
    """
    text = decode_text(body)
    command: Command
    match text.lower().split():
        case ["version", number] if re.fullmatch(r"\d{1,4}\.\d{1,4}", number, re.ASCII):
            command = Version(number)
        case ["setbyteorder", ("bigendian" | "littleendian") as order]:
            command = SetByteOrder("big" if order == "bigendian" else "little")
        case ["sendparameters", *names]:
            command = SendParameters(_parse_names(names, _SECTION_BY_WORD, "section"))
        case ["sendcurrentframe", *names]:
            command = SendCurrentFrame(_parse_names(names, _COMPONENT_BY_WORD, "component"))
        case ["streamframes", *parameters]:
            command = _parse_stream_frames(parameters)
        case ["bye"]:
            command = Bye()
        case ["recording", *_]:
            command = _parse_recording(text[len("recording") :].strip())
        case [verb, *_]:
            raise CommandError(
                _USAGE.get(verb) or f"Unknown command {_quote(text.split()[0])}; {_KNOWN_COMMANDS}"
            )
        case _:
            raise CommandError(f"Empty command; {_KNOWN_COMMANDS}")
    return command


def _parse_recording(parameter: str) -> ControlRecording:
    """Return the command with this parameter, which may contain a file name with spaces."""
    action = parameter[:5].lower()
    if action == "start" and parameter[5:6] in {"", ",", " "}:
        return ControlRecording(start=True, options=parameter[5:])
    if action.startswith("stop") and parameter[4:5] in {"", ",", " "}:
        return ControlRecording(start=False)
    raise CommandError("Recording takes Start or Stop, as in: Recording Start,file=take.c3d")


def recording_options(text: str) -> dict[str, str]:
    """Return the options in a command that starts a recording, or in its reply, by keyword in lower case."""
    return {keyword.lower(): value.strip() for keyword, value in _OPTION.findall(text)}


def recording_duration_s(options: str) -> float | None:
    """Return the duration in the options of a recording, None if there is none. Raises CommandError."""
    named = recording_options(options)
    if "duration" not in named:
        return None
    unit_s = _UNITS_S.get(named.get("durationunits", "seconds").lower())
    if unit_s is None or not _NUMBER.fullmatch(named["duration"]):
        raise CommandError(
            f"duration takes a number, and durationunits one of {', '.join(_UNITS_S)}, as in: "
            "Recording Start,file=take1,duration=5,durationunits=seconds"
        )
    return float(named["duration"]) * unit_s


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
    return StreamFrames(rate, _parse_names(names, _COMPONENT_BY_WORD, "parameter", others))


def _parse_rate(word: str) -> Rate | None:
    """Return the rate in a lower-case parameter; None if it is not a rate parameter."""
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
        f"Unknown rate {_quote(word)}; known are FrequencyDivisor:n (n a whole number from 1), "
        "Frequency:n (n Hz, above 0), AllFrames"
    )


def _parse_names(
    words: Sequence[str], known: dict[str, _Named], noun: str, others: Sequence[str] = ()
) -> tuple[_Named, ...]:
    """Return the values of ``known`` that ``words`` name, each once, in order; () for All or no words.

    ``noun`` and ``others``, the other parameters of the command, are for the error text.
    """
    by_word = {word.lower(): named for word, named in known.items()}
    named: dict[_Named, None] = {}
    for word in words:
        if word in by_word:
            named[by_word[word]] = None
        elif word != "all":
            accepted = ", ".join(["All", *known, *others])
            raise CommandError(f"Unknown {noun} {_quote(word)}; known are {accepted}")
    return () if "all" in words else tuple(named)


def _quote(word: str) -> str:
    """Return a client's word for an error text, which is ASCII."""
    return quoted(word).encode("ascii", "replace").decode()
