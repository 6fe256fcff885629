"""What a ``status_t`` says about a source: the report that every display, list and health page shows.

Anybody on the network can send a status. So this module has the limits for all that read one: at most
MAX_STREAMS streams, at most MAX_ENTRIES entries of each other kind, and texts that are cut and escaped
(``safe_text``). Programs may cut them further to fit their page.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from typing import Any, Final, NamedTuple, TypeVar

from gateway.runtime.safe_text import safe_text

MAX_STREAMS: Final = 16
"""How many streams of a source are kept. A source of the gateway has one for each component at most."""

MAX_ENTRIES: Final = 50
"""How many outputs, limitations, causes and counts are kept, of each kind. The gateway has fewer of all."""

_Entry = TypeVar("_Entry")


class Level(Enum):
    """How well something works."""

    GOOD = "good"
    WAITING = "waiting"
    BAD = "bad"


class State(NamedTuple):
    """A state in words, and how well something works."""

    level: Level
    text: str


_STATES: Final = {
    "streaming": (Level.GOOD, "streaming {rate_hz:.1f} Hz"),
    "idle": (Level.WAITING, "connected to {server}, no frames requested"),
    "no measurement": (Level.WAITING, "connected to {server}, no measurement running"),
    "handshaking": (Level.WAITING, "connected to {server}, handshake in progress"),
    "stalled": (Level.BAD, "no frames from {server}"),
    "connecting": (Level.BAD, "waiting for {server}{tries}"),
    "waiting to reconnect": (Level.BAD, "waiting for {server}{tries}"),
}
"""What each state of a stream (gateway.session.state) means. Other versions of the gateway may have more."""


class LossReport(NamedTuple):
    """What was lost for one cause, since the gateway's start."""

    cause: str
    num_messages: int
    num_frames: int


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One stream of a source. ``stream_status_t`` describes what is not described here."""

    components: str
    """Their keys, separated by spaces."""
    state: str
    level: Level
    text: str
    """What the status line says: the problem, or a sentence about the state."""
    problem: str
    """Why nothing is published although frames arrive; "" if that is not so."""
    session: int
    byte_order: str
    rate: str
    """The rate request that the server accepted."""
    frame_rate_hz: float
    lag_ms: float
    tries: int
    num_frames: int
    num_reconnects: int
    num_restarts: int
    has_clock: bool
    clock_drift_ppm: float
    clock_uncertainty_us: float
    limitations: list[str]
    last_error: str
    last_error_utime: int
    losses: list[LossReport]
    """What was lost before any output."""


@dataclass(frozen=True, slots=True)
class OutputReport:
    """One output of the gateway. ``messages`` are by component, ``queries`` by result."""

    output: str
    is_connected: bool
    problem: str
    messages: dict[str, int]
    queries: dict[str, int]
    losses: list[LossReport]


@dataclass(frozen=True, slots=True)
class SourceReport:
    """What a gateway says about a source, or a ``problem`` why that is not known, or not all of it."""

    name: str
    gateway: str = ""
    """The id of the gateway's Zenoh session, if the status came from there."""
    problem: str = ""
    server: str = ""
    """HOST:PORT."""
    host: str = ""
    """The gateway's computer."""
    version: str = ""
    """The gateway's version."""
    utime: int = 0
    sequence: int = 0
    frame_id: str = ""
    metres_per_unit: float = 0.0
    rotation_xyzw: Sequence[float] = ()
    translation_m: Sequence[float] = ()
    streams: Sequence[StreamReport] = ()
    outputs: Sequence[OutputReport] = ()
    routers: Sequence[str] | None = None
    """The names of the Zenoh routers between, the gateway's first; None if they are not known."""

    @property
    def text(self) -> str:
        """What the status line says about all streams; "" without any."""
        return streams_text((stream.components, stream.text) for stream in self.streams)

    @property
    def level(self) -> Level:
        """The worst level of a stream; WAITING without any."""
        levels = {stream.level for stream in self.streams}
        if Level.BAD in levels:
            return Level.BAD
        return Level.GOOD if levels == {Level.GOOD} else Level.WAITING

    @property
    def components(self) -> list[str]:
        """The keys of the components of all streams, each once."""
        return list(dict.fromkeys(key for stream in self.streams for key in stream.components.split()))


def source_report(status: Any, name: str = "", gateway: str = "") -> SourceReport:
    """Return what a ``status_t`` says about the source ``name``; if that is "", the status names it."""
    server, num_streams = safe_text(status.server), len(status.streams)
    return SourceReport(
        name=safe_text(name or status.source),
        gateway=gateway,
        problem=(
            f"it has {num_streams} streams; {MAX_STREAMS} are shown" if num_streams > MAX_STREAMS else ""
        ),
        server=server,
        host=safe_text(status.host),
        version=safe_text(status.gateway_version),
        utime=status.utime,
        sequence=status.sequence,
        frame_id=safe_text(status.frame_id),
        metres_per_unit=status.metres_per_unit,
        rotation_xyzw=status.rotation_xyzw,
        translation_m=status.translation_m,
        streams=[_stream(stream, server) for stream in status.streams[:MAX_STREAMS]],
        outputs=[_output(output) for output in _first(status.outputs)],
    )


def _stream(stream: Any, server: str) -> StreamReport:
    state, problem = safe_text(stream.state), safe_text(stream.problem)
    level, text = _STATES.get(stream.state, (Level.WAITING, ""))
    tries = f", {stream.tries} {'try' if stream.tries == 1 else 'tries'}" if stream.tries else ""
    return StreamReport(
        components=safe_text(stream.components),
        state=state,
        level=Level.BAD if problem else level,
        text=problem or text.format(server=server, rate_hz=stream.frame_rate_hz, tries=tries) or state,
        problem=problem,
        session=stream.session,
        byte_order=safe_text(stream.byte_order),
        rate=safe_text(stream.rate),
        frame_rate_hz=stream.frame_rate_hz,
        lag_ms=stream.lag_ms,
        tries=stream.tries,
        num_frames=stream.frames_in,
        num_reconnects=stream.reconnects,
        num_restarts=stream.restarts,
        has_clock=bool(stream.clock.has_clock),
        clock_drift_ppm=stream.clock.drift_ppm,
        clock_uncertainty_us=stream.clock.uncertainty_us,
        limitations=[safe_text(text) for text in _first(stream.limitations)],
        last_error=safe_text(stream.last_error),
        last_error_utime=stream.last_error_utime,
        losses=_losses(stream.drops),
    )


def _output(output: Any) -> OutputReport:
    return OutputReport(
        output=safe_text(output.name),
        is_connected=bool(output.connected),
        problem=safe_text(output.problem),
        messages=_counts(output.messages),
        queries=_counts(output.queries),
        losses=_losses(output.drops),
    )


def _losses(losses: Iterable[Any]) -> list[LossReport]:
    return [LossReport(safe_text(loss.cause), loss.messages, loss.frames) for loss in _first(losses)]


def _counts(counts: Iterable[Any]) -> dict[str, int]:
    return {safe_text(each.name): each.count for each in _first(counts)}


def _first(entries: Iterable[_Entry]) -> list[_Entry]:
    return [*islice(entries, MAX_ENTRIES)]


def streams_text(streams: Iterable[tuple[str, str]]) -> str:
    """Return one text about all streams of a source; ``streams`` are pairs of components and a text.

    If the texts differ, the components of each stream precede its text.
    """
    pairs = [*streams]
    if len({text for _, text in pairs}) == 1:
        return pairs[0][1]
    return ", ".join(f"{components} {text}" for components, text in pairs)
