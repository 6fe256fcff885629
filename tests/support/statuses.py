"""Parts of status messages that tests invent, and losses as they compare them."""

from collections.abc import Iterable
from typing import Any

import rtc3d

from gateway.runtime.losses import Loss


def stream(components: str = "3d 6d", state: str = "streaming", **fields: Any) -> rtc3d.stream_status_t:
    """Return the status of a stream."""
    status = rtc3d.stream_status_t()
    status.components, status.state, status.frame_rate_hz = components, state, 200.0
    for name, value in fields.items():
        setattr(status, name, value)
    status.num_drops, status.num_limitations = len(status.drops), len(status.limitations)
    return status


def output(name: str = "zenoh", **fields: Any) -> rtc3d.output_status_t:
    """Return the status of an output."""
    status = rtc3d.output_status_t()
    status.name, status.connected = name, True
    for field, value in fields.items():
        setattr(status, field, value)
    status.num_messages, status.num_drops = len(status.messages), len(status.drops)
    status.num_queries = len(status.queries)
    return status


def count(name: str, number: int) -> rtc3d.count_t:
    """Return a number of messages or queries."""
    message = rtc3d.count_t()
    message.name, message.count = name, number
    return message


def loss(cause: str, messages: int, frames: int) -> rtc3d.loss_t:
    """Return what was lost for one cause."""
    message = rtc3d.loss_t()
    message.cause, message.messages, message.frames = cause, messages, frames
    return message


def amounts(losses: Iterable[Loss]) -> dict[str, tuple[int, int]]:
    """Return (messages, frames) by cause."""
    return {loss.cause: (loss.messages, loss.frames) for loss in losses}
