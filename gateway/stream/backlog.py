"""The pace of a backlog: many frames that arrived together because something stood still.

The cause can be this process, the network or the server. If all of these frames were published at once, the
loss would only move: subscribers with small buffers, such as those of LCM over UDP, could not take them.
So a backlog is published like a recording that is played at a multiple of its speed. Each subscriber then has
to take that multiple of its usual load, whatever the rate and the size of the frames are.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from gateway.rtc3d.frames import Frame
from gateway.stream.clock import ServerClock
from gateway.stream.process_clock import running_clock

_MAX_WAIT_S: Final = 0.005
"""The longest time between two frames, so that gaps and low rates do not delay a backlog."""

_MAX_LATE_S: Final = 0.015
"""If the event loop calls too late, publishing frames together makes up for at most this much."""

_IDLE_S: Final = 0.5
"""A backlog that begins within this time after another one continues its pace, as in a stream of batches."""

_TURN_S: Final = 0.002
"""How long one call publishes, or one frame if that takes longer; then other sources have their turn."""

_RESOLUTION_S: Final = 0.001
"""The event loop's timers have whole milliseconds, so what is due in the next one is published now."""

_MAX_CHUNK: Final = 16
_MAX_CHUNK_WITHOUT_PACE: Final = 64
"""How many frames are published between two readings of the clock at most."""


class Backlog:
    """The frames of one session that wait to be published, and when each is due.

    ``publish`` takes frames and when they arrived, as Ingest.receive does. ``speed`` is the pace as a
    multiple of the stream's own, according to the server's time stamps while they are those of a ``clock``.
    Without a clock, or if ``speed`` is None because ``publish`` skips late frames, every frame is due at
    once; a call of ``publish_due`` still takes a limited time. ``read_clocks`` does the same as
    HostClock.read.

    The session stops reading while frames wait, so the number of frames is limited by the size of one read.
    """

    def __init__(
        self,
        publish: Callable[[list[Frame], int, int], None],
        clock: ServerClock,
        speed: float | None,
        read_clocks: Callable[[], tuple[int, int]],
    ) -> None:
        self._publish = publish
        self._clock = clock
        self._speed = speed
        self._skips_frames = speed is None
        self._frame_s = 0.0  # how long it took to publish one of the newest frames
        self._read_clocks = read_clocks
        self._frames: list[Frame] = []  # waiting, without those before _next
        self._next = 0
        self._utime = 0  # when they arrived
        self._arrival_us = 0  # the same on the steady clock
        self._due_s = 0.0  # when the next frame is due, on the steady clock
        self._timestamp_us: int | None = None  # of the newest frame published at a pace

    @property
    def is_empty(self) -> bool:
        """Whether no frames wait."""
        return not self._frames

    def add(self, frames: list[Frame], utime: int, steady_us: int) -> None:
        """Take frames that arrived together, oldest first; see Ingest.receive. Publishes nothing yet."""
        if self._frames:
            del self._frames[: self._next]
            self._frames += frames
        else:
            self._frames = frames
            now_s = steady_us * 1e-6
            if now_s - self._due_s > _IDLE_S:
                self._due_s = now_s
                self._timestamp_us = None
        self._next = 0
        self._utime = utime
        self._arrival_us = steady_us

    def is_quick(self, num_frames: int) -> bool:
        """Return whether so many frames can be published in one turn, judged by the newest ones."""
        return num_frames * self._frame_s <= _TURN_S

    def publish(self, frames: list[Frame], utime: int, steady_us: int) -> None:
        """Publish frames at once, because nothing waits."""
        began_s = self._now_s()
        self._publish(frames, utime, steady_us)
        self._frame_s = (self._now_s() - began_s) / len(frames)

    def publish_due(self) -> float | None:
        """Publish what is due. Return in how many s to call again, or None if nothing waits any more."""
        now_s = self._now_s()
        end_s = now_s + _TURN_S
        self._due_s = max(self._due_s, now_s - _MAX_LATE_S)
        while self._frames and now_s < end_s:
            end = self._end_of_due(now_s)
            if end == self._next:
                return self._due_s - now_s
            self._publish_until(end)
            now_s = self._now_s()
        return 0.0 if self._frames else None

    def hurry(self) -> None:
        """From now on, every frame is due at once."""
        self._speed = None

    def clear(self) -> None:
        """Drop what waits."""
        self._frames = []
        self._next = 0

    def _now_s(self) -> float:
        return self._read_clocks()[1] * 1e-6

    def _end_of_due(self, now_s: float) -> int:
        """Return the index after the last of the next frames that is due; plan when the one after it is."""
        at = self._next
        speed = self._speed
        has_pace = speed is not None and self._clock.has_clock
        num_frames = _MAX_CHUNK if has_pace else _MAX_CHUNK_WITHOUT_PACE
        # Frames that take long, such as those of hundreds of tools, are published one by one. If late frames
        # are skipped, only the last one of a chunk takes any time.
        while not self._skips_frames and num_frames > 1 and not self.is_quick(num_frames):
            num_frames //= 2
        last = min(len(self._frames), at + num_frames)
        while at < last:
            frame = self._frames[at]
            if speed is not None and has_pace:
                if self._due_s >= now_s + _RESOLUTION_S:
                    break
                self._due_s += self._wait_s(frame, speed)
            at += 1
        return at

    def _wait_s(self, frame: Frame, speed: float) -> float:
        """Return how long to wait after ``frame`` was due: as long as after the one before it."""
        if frame.layout.first_component_type is None:
            return 0.0
        _, timestamp_us = frame.number_and_timestamp
        before_us = self._timestamp_us
        self._timestamp_us = timestamp_us
        if before_us is None or timestamp_us <= before_us:
            return 0.0
        return min((timestamp_us - before_us) / (1e6 * speed), _MAX_WAIT_S)

    def _publish_until(self, end: int) -> None:
        frames = self._frames[self._next : end]
        if end == len(self._frames):
            self.clear()
        else:
            self._next = end
        self.publish(frames, self._utime, self._arrival_us)


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
