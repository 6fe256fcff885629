"""Passes the frames of one session on: at once, or as a backlog at its pace."""

import asyncio
from collections.abc import Callable
from typing import Final

from gateway.rtc3d.frames import Frame
from gateway.stream.backlog import Backlog
from gateway.stream.running_clock import running_clock

MAX_TOGETHER: Final = 4
"""Up to this many frames that arrive together are passed on at once if that is quick. More are a backlog."""


class PacedFrames:
    """Decides whether frames are a backlog, and passes it on when it is due.

    While a backlog waits, it stops reading from the server with ``set_reading``. So the data stays in the
    kernel, and TCP makes the server wait when the kernel's buffer is full: memory is limited, and the other
    sources get their turn. ``backlog`` publishes the frames; ``on_defect`` takes what that raises meanwhile.
    """

    def __init__(
        self,
        backlog: Backlog,
        set_reading: Callable[[bool], None],
        on_defect: Callable[[Exception], None],
    ) -> None:
        self._backlog = backlog
        self._set_reading = set_reading
        self._on_defect = on_defect
        self._running = running_clock()
        self._timer: asyncio.Handle | None = None  # set while frames wait
        self.caught_up_s = 0.0
        """When a part of a backlog was last passed on, on the running clock; 0 before the first."""

    def receive(self, frames: list[Frame], utime: int, steady_us: int) -> None:
        """Take frames that arrived together, oldest first; see Ingest.receive."""
        backlog = self._backlog
        is_quick = len(frames) == 1 or (len(frames) <= MAX_TOGETHER and backlog.is_quick(len(frames)))
        if is_quick and backlog.is_empty:
            backlog.publish(frames, utime, steady_us)
            return
        backlog.add(frames, utime, steady_us)
        if self._timer is None:
            self._pass_on()

    @property
    def is_empty(self) -> bool:
        """Whether no frames wait."""
        return self._backlog.is_empty

    def finish(self) -> None:
        """Pass on what waits, and what comes after it, without a pace: the session has ended."""
        self._backlog.hurry()
        if self._timer is not None:
            self._timer.cancel()
            self._pass_on()

    def drop(self) -> None:
        """Drop what waits, because passing it on has failed."""
        self._backlog.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._set_reading(True)

    def _pass_on(self) -> None:
        """Pass on the part of the backlog that is due; read from the server again when nothing is left."""
        self._timer = None
        try:
            wait_s = self._backlog.publish_due()
            # What follows has not been read yet, so silence and unanswered commands mean nothing.
            self.caught_up_s = self._running.time()
            self._set_reading(wait_s is None)
        except Exception as defect:  # noqa: BLE001 - the session reports it
            self._on_defect(defect)
            self.drop()
            return
        if wait_s is not None:
            self._timer = self._running.loop.call_later(wait_s, self._pass_on)
