"""What was lost, as the tests compare it."""

from collections.abc import Iterable

from gateway.logs.losses import Loss


def amounts(losses: Iterable[Loss]) -> dict[str, tuple[int, int]]:
    """Return (messages, frames) by cause."""
    return {loss.cause: (loss.messages, loss.frames) for loss in losses}
