"""The LCM messages that report the state of a source: ``status_t`` and ``clock_t``."""

import socket
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import rtc3d

from gateway import __version__
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.host_time import host_clock, now_utime
from gateway.outputs.contract import OutputHealth, OutputStatus
from gateway.rtc3d.components import ComponentType
from gateway.runtime.losses import Loss
from gateway.session.clock import ServerClock
from gateway.session.process_clock import running_clock
from gateway.session.status import FRAME_REJECTED, StreamStatus

_COPIED_FIELDS: Final = (
    "components",
    "tries",
    "byte_order",
    "rate",
    "session",
    "frames_in",
    "bytes_in",
    "reconnects",
    "restarts",
    "last_error",
    "last_error_utime",
)
"""Fields of ``stream_status_t`` with the same name and value in StreamStatus."""

_MIN_INT64: Final = -(1 << 63)
_MAX_INT64: Final = (1 << 63) - 1


def status_message(
    *,
    source: str,
    server: str,
    sequence: int,
    streams: Sequence[tuple[StreamStatus, float]],
    outputs: Iterable[tuple[OutputStatus, OutputHealth, Mapping[str, int]]],
    stall_timeout_s: float,
    frame: CoordinateFrame,
) -> rtc3d.status_t:
    """Return the status of one source.

    ``server`` is HOST:PORT. ``streams`` are pairs of a stream's status and its frame rate in Hz. Each output
    comes with its health and the number of queries about the source by result. ``frame`` is that of poses.
    """
    message = rtc3d.status_t()
    message.utime = message.capture_utime = now_utime()
    message.sequence = sequence
    message.session = max((stream.session for stream, _ in streams), default=0)
    message.parameters_version = max((stream.parameters_version for stream, _ in streams), default=0)
    message.source = source
    message.server = server
    message.gateway_version = __version__
    message.host = socket.gethostname()
    message.frame_id = frame.frame_id
    message.metres_per_unit = frame.metres_per_unit or 0.0
    message.rotation_xyzw = list(frame.rotation_xyzw)
    message.translation_m = list(frame.translation_m)
    message.streams = [_stream_message(stream, rate_hz, stall_timeout_s) for stream, rate_hz in streams]
    message.num_streams = len(message.streams)
    message.outputs = [_output_message(*output) for output in outputs]
    message.num_outputs = len(message.outputs)
    return message


def clock_message(session: int, sequence: int, stream: StreamStatus) -> rtc3d.clock_t:
    """Return the clock of one stream; ``session`` is that of the newest connection of the source."""
    message = rtc3d.clock_t()
    message.utime = message.capture_utime = now_utime()
    message.sequence = sequence
    message.session = session
    message.parameters_version = stream.parameters_version
    message.components = stream.components
    message.clock = clock_model(stream.clock)
    return message


def clock_model(clock: ServerClock) -> rtc3d.clock_model_t:
    """Return the model of a server's clock; without a clock, all fields but ``samples`` are 0."""
    model = rtc3d.clock_model_t()
    model.has_clock = clock.has_clock
    if clock.has_clock:
        offset_us = clock.offset_us + host_clock.offset_us
        model.offset_us = max(_MIN_INT64, min(offset_us, _MAX_INT64))  # a server may count from any number
        model.drift_ppm = clock.drift_ppm
        model.uncertainty_us = clock.uncertainty_us
    model.samples = clock.samples
    return model


def _stream_message(stream: StreamStatus, rate_hz: float, stall_timeout_s: float) -> rtc3d.stream_status_t:
    message = rtc3d.stream_status_t()
    for name in _COPIED_FIELDS:
        setattr(message, name, getattr(stream, name))
    message.state = stream.state.value
    message.problem = unusable_frames(stream, stall_timeout_s)
    message.frame_rate_hz = rate_hz
    message.lag_ms = 1000 * stream.lag_s
    message.clock = clock_model(stream.clock)
    message.drops = _losses(stream.losses.report())
    message.num_drops = len(message.drops)
    message.limitations = list(stream.limitations)
    message.num_limitations = len(message.limitations)
    return message


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


def _output_message(
    output: OutputStatus, health: OutputHealth, queries: Mapping[str, int]
) -> rtc3d.output_status_t:
    message = rtc3d.output_status_t()
    message.name = output.name
    message.connected = health.connected
    message.problem = health.problem
    message.messages = _counts(output.messages)
    message.num_messages = len(message.messages)
    message.drops = _losses(output.losses)
    message.num_drops = len(message.drops)
    message.queries = _counts(queries)
    message.num_queries = len(message.queries)
    return message


def _counts(counter: Mapping[str, int]) -> list[rtc3d.count_t]:
    messages = []
    for name, count in sorted(counter.items()):
        message = rtc3d.count_t()
        message.name = name
        message.count = count
        messages.append(message)
    return messages


def _losses(losses: Iterable[Loss]) -> list[rtc3d.loss_t]:
    messages = []
    for loss in losses:
        message = rtc3d.loss_t()
        message.cause, message.messages, message.frames = loss.cause, loss.messages, loss.frames
        messages.append(message)
    return messages
