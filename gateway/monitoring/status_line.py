"""The texts of the status line that ``systemctl status`` shows."""

from collections.abc import Iterable, Sequence

from gateway.config.settings import SourceSettings
from gateway.gateway import Gateway
from gateway.losses import Loss, last_minute_text
from gateway.outputs.status import OutputHealth
from gateway.stream.status import StreamStatus
from gateway.stream.status_text import source_text, stream_text, unusable_frames


def status_lines(gateway: Gateway) -> list[str]:
    """Return a text for each source, for each output that cannot send, and for what an output loses."""
    outputs = ((output.name, output.health()) for output in gateway.outputs)
    losses = (
        (f"{source.name} to {output.name}", status.losses)
        for source in gateway.sources
        for output, status in source.fan_out.outputs
    )
    return [
        *(source_line(source.settings, source.rated_statuses) for source in gateway.sources),
        *output_lines(outputs),
        *loss_lines(losses),
    ]


def source_line(source: SourceSettings, streams: Sequence[tuple[StreamStatus, float]]) -> str:
    """Return the status of a source, such as "lab: streaming 200.0 Hz".

    ``streams`` are pairs of a status and a frame rate in Hz. If their texts differ, the components of each
    stream precede its text.
    """
    server = f"{source.host}:{source.port}"
    texts = []
    for status, rate_hz in streams:
        problem = unusable_frames(status, source.stall_timeout_s)
        text = problem or stream_text(status.state, server, rate_hz, status.tries)
        lost = last_minute_text(status.losses.report())
        texts.append((status.components, f"{text}, {lost}" if lost else text))
    return f"{source.name}: {source_text(texts)}"


def output_lines(outputs: Iterable[tuple[str, OutputHealth]]) -> list[str]:
    """Return a text for each output that cannot send; ``outputs`` are pairs of a name and its health."""
    return [f"{name}: {health.problem}" for name, health in outputs if not health.connected]


def loss_lines(losses: Iterable[tuple[str, Sequence[Loss]]]) -> list[str]:
    """Return a text for each output that lost something in the last minute.

    ``losses`` are pairs of the route, such as "lab to zenoh", and what was lost on it.
    """
    return [f"{route}: {text}" for route, lost in losses if (text := last_minute_text(lost))]
