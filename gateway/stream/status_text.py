"""Texts about the state of a source's streams, for the status line and for commands that show the same."""

from collections.abc import Sequence
from enum import Enum
from typing import Any, Final

from gateway.logs.safe_text import safe_text
from gateway.rtc3d.components import ComponentType
from gateway.stream.process_clock import running_clock
from gateway.stream.state import StreamState
from gateway.stream.status import FRAME_REJECTED, StreamStatus


class Level(Enum):
    """How well something works."""

    GOOD = "good"
    WAITING = "waiting"
    BAD = "bad"


_LEVELS: Final = {
    StreamState.STREAMING.value: Level.GOOD,
    StreamState.STALLED.value: Level.BAD,
    StreamState.WAITING.value: Level.BAD,
    StreamState.CONNECTING.value: Level.BAD,
}
"""The others, and states of other versions of the gateway, are between these."""


def stream_level(state: str, problem: str) -> Level:
    """Return how well a stream works, by two fields of its ``stream_status_t``."""
    return Level.BAD if problem else _LEVELS.get(state, Level.WAITING)


def source_text(streams: Sequence[tuple[str, str]]) -> str:
    """Return one text about all streams of a source; ``streams`` are pairs of components and a text.

    If the texts differ, the components of each stream precede its text.
    """
    if len({text for _, text in streams}) == 1:
        return streams[0][1]
    return ", ".join(f"{components} {text}" for components, text in streams)


def message_texts(status: Any) -> list[tuple[str, str]]:
    """Return the components of each stream of a ``status_t``, and what the status line says about it.

    The message may come from anybody: its texts are cut, and an unknown state is returned as it is.
    """
    server, texts = safe_text(status.server), []
    for stream in status.streams:
        try:
            text = stream_text(StreamState(stream.state), server, stream.frame_rate_hz, stream.tries)
        except ValueError:
            text = safe_text(stream.state)
        texts.append((safe_text(stream.components), safe_text(stream.problem) or text))
    return texts


def stream_text(state: StreamState, server: str, rate_hz: float, tries: int) -> str:
    """Return the state of a stream, such as "streaming 200.0 Hz".

    ``server`` is HOST:PORT; ``tries`` counts the attempts to connect since the last connection.
    """
    match state:
        case StreamState.STREAMING:
            return f"streaming {rate_hz:.1f} Hz"
        case StreamState.IDLE:
            return f"connected to {server}, no frames requested"
        case StreamState.NO_MEASUREMENT:
            return f"connected to {server}, no measurement running"
        case StreamState.HANDSHAKING:
            return f"connected to {server}, handshake in progress"
        case StreamState.STALLED:
            return f"no frames from {server}"
        case StreamState.CONNECTING | StreamState.WAITING:
            return f"waiting for {server}" + (
                f", {tries} {'try' if tries == 1 else 'tries'}" if tries else ""
            )


def unusable_frames(status: StreamStatus, max_age_s: float) -> str:
    """Return why nothing is published although frames come; "" if frames are usable, or none come.

    ``max_age_s`` is how long this must last, or how old the newest frame may be.
    """
    rejected = next((loss for loss in status.losses.report() if loss.cause == FRAME_REJECTED), None)
    if rejected is not None and rejected.age_s < max_age_s and not _is_recent(status.last_frame_s, max_age_s):
        reason = rejected.text.removeprefix(f"{FRAME_REJECTED}: ")
        return f"frames come, and all are rejected: {reason}"
    if (
        status.unwanted_components
        and status.components != ComponentType.EVENT.key  # events are sporadic
        and _is_recent(status.last_frame_s, max_age_s)
        and not _is_recent(status.unwanted_since_s, max_age_s)
    ):
        return (
            f"frames come, and none has a component of this stream ({status.components}); the newest has "
            f"{status.unwanted_components}: check the server's real-time output, and sources.streams"
        )
    return ""


def _is_recent(time_s: float | None, max_age_s: float) -> bool:
    """Return whether a time on the running clock is at most ``max_age_s`` ago."""
    return time_s is not None and running_clock().time() - time_s <= max_age_s
