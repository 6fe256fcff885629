"""When a session publishes what has arrived, and when it reads on.

Many frames arrive together because something stood still: this process, the network or the server. If all of
such a backlog were published at once, the loss would only move: subscribers with small buffers, such as those
of LCM over UDP, could not take it. So it is published like a recording that is played at a multiple of its
speed. Each subscriber then has to take that multiple of its usual load, whatever the rate and the size of the
frames are. Meanwhile, the session reads nothing.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from gateway.rtc3d.frames import RawFrame
from gateway.session.clock import ServerClock
from gateway.session.process_clock import running_clock

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

MAX_TOGETHER: Final = 4
"""Up to this many frames that arrive together are published at once if that is quick. More are a backlog."""

OnFrames = Callable[[list[RawFrame], int, int], None]
"""Takes frames that arrived together, oldest first, and when, as ``HostClock.read`` returns it."""

ReadClocks = Callable[[], tuple[int, int]]
"""Returns the time in µs since the Unix epoch and on a steady clock, as ``HostClock.read`` does."""


class BacklogPace:
    """When the frames of a backlog are due: at the stream's own pace, times ``speed``.

    That is according to the server's time stamps while they are those of a ``clock``. Without a clock, or if
    ``speed`` is None, every frame is due at once.
    """

    def __init__(self, clock: ServerClock, speed: float | None) -> None:
        self.due_s = 0.0
        """When the next frame is due, on the steady clock."""
        self._clock = clock
        self._speed = speed
        self._timestamp_us: int | None = None  # of the newest frame published at a pace

    @property
    def is_limited(self) -> bool:
        """Whether frames wait until they are due."""
        return self._speed is not None and self._clock.has_clock

    def begin(self, now_s: float) -> None:
        """Begin a backlog. If it follows another one closely, it continues the pace of that."""
        if now_s - self.due_s > _IDLE_S:
            self.due_s = now_s
            self._timestamp_us = None

    def catch_up(self, now_s: float) -> None:
        """Limit how late the next frame is: that much is made up for."""
        self.due_s = max(self.due_s, now_s - _MAX_LATE_S)

    def is_due(self, now_s: float) -> bool:
        """Return whether the next frame is due."""
        return self.due_s < now_s + _RESOLUTION_S

    def plan_after(self, frame: RawFrame) -> None:
        """Plan the frame after ``frame``: it waits as long as ``frame`` did after the one before."""
        speed = self._speed
        if speed is None or frame.layout.first_component_type is None:
            return
        _, timestamp_us = frame.number_and_timestamp
        before_us = self._timestamp_us
        self._timestamp_us = timestamp_us
        if before_us is not None and timestamp_us > before_us:
            self.due_s += min((timestamp_us - before_us) / (1e6 * speed), _MAX_WAIT_S)

    def end(self) -> None:
        """Let every frame be due at once from now on."""
        self._speed = None


class Backlog:
    """The frames of one session: a few are published at once, and others wait until they are due.

    ``publish`` takes frames as Ingest.receive does. ``clock`` and ``speed`` say when they are due (see
    BacklogPace); ``speed`` is None if ``publish`` skips late frames. One call takes a limited time in any
    case.

    ``on_waiting`` is called with whether frames wait. The session stops reading while they do, so the data
    stays in the kernel, and TCP makes the server wait when the kernel's buffer is full: the number of frames
    is limited by the size of one read, and the other sources get their turn. ``on_defect`` takes what
    ``publish`` raises while frames wait.
    """

    def __init__(
        self,
        publish: OnFrames,
        clock: ServerClock,
        speed: float | None,
        read_clocks: ReadClocks,
        on_waiting: Callable[[bool], None],
        on_defect: Callable[[Exception], None],
    ) -> None:
        self.caught_up_s = 0.0
        """When a part of a backlog was last published, on the running clock; 0 before the first."""
        self._publish = publish
        self._pace = BacklogPace(clock, speed)
        self._skips_frames = speed is None
        self._frame_s = 0.0  # how long it took to publish one of the newest frames
        self._read_clocks = read_clocks
        self._on_waiting = on_waiting
        self._on_defect = on_defect
        self._timer: asyncio.Handle | None = None  # set while frames wait
        self._frames: list[RawFrame] = []  # waiting, without those before _next
        self._next = 0
        self._utime = 0  # when they arrived
        self._arrival_us = 0  # the same on the steady clock

    @property
    def is_empty(self) -> bool:
        """Whether no frames wait."""
        return not self._frames

    def receive(self, frames: list[RawFrame], utime: int, steady_us: int) -> None:
        """Take frames that arrived together, oldest first; see Ingest.receive."""
        is_quick = len(frames) == 1 or (len(frames) <= MAX_TOGETHER and self._is_quick(len(frames)))
        if is_quick and not self._frames:
            self._publish_together(frames, utime, steady_us)
            return
        if self._frames:
            del self._frames[: self._next]
            self._frames += frames
        else:
            self._frames = frames
            self._pace.begin(steady_us * 1e-6)
        self._next = 0
        self._utime = utime
        self._arrival_us = steady_us
        if self._timer is None:
            self._publish_part()

    def finish(self) -> None:
        """Publish what waits, and what comes after it, without a pace: the session has ended."""
        self._pace.end()
        if self._timer is not None:
            self._timer.cancel()
            self._publish_part()

    def drop(self) -> None:
        """Drop what waits, because publishing has failed."""
        self._frames = []
        self._next = 0
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._on_waiting(False)

    def _is_quick(self, num_frames: int) -> bool:
        """Return whether so many frames can be published in one turn, judged by the newest ones."""
        return num_frames * self._frame_s <= _TURN_S

    def _publish_together(self, frames: list[RawFrame], utime: int, steady_us: int) -> None:
        began_us = self._read_clocks()[1]
        self._publish(frames, utime, steady_us)
        self._frame_s = (self._read_clocks()[1] - began_us) * 1e-6 / len(frames)

    def _publish_part(self) -> None:
        """Publish the part of the backlog that is due, and let the session read when nothing is left."""
        self._timer = None
        running = running_clock()
        try:
            wait_s = self._publish_due()
            # What follows has not been read yet, so silence and unanswered commands mean nothing.
            self.caught_up_s = running.time()
            self._on_waiting(wait_s is not None)
        except Exception as defect:  # noqa: BLE001 - the session reports it
            self._on_defect(defect)
            self.drop()
            return
        if wait_s is not None:
            self._timer = running.loop.call_later(wait_s, self._publish_part)

    def _publish_due(self) -> float | None:
        """Publish what is due. Return in how many s to call again, or None if nothing waits any more."""
        now_s = self._read_clocks()[1] * 1e-6
        end_s = now_s + _TURN_S
        self._pace.catch_up(now_s)
        while self._frames and now_s < end_s:
            end = self._end_of_due(now_s)
            if end == self._next:
                return self._pace.due_s - now_s
            frames = self._frames[self._next : end]
            self._next = end
            if end == len(self._frames):
                self._frames = []
                self._next = 0
            self._publish_together(frames, self._utime, self._arrival_us)
            now_s = self._read_clocks()[1] * 1e-6
        return 0.0 if self._frames else None

    def _end_of_due(self, now_s: float) -> int:
        """Return the index after the last of the next frames that is due; plan when the one after it is."""
        at = self._next
        pace = self._pace
        has_pace = pace.is_limited
        num_frames = _MAX_CHUNK if has_pace else _MAX_CHUNK_WITHOUT_PACE
        # Frames that take long, such as those of hundreds of tools, are published one by one. If late frames
        # are skipped, only the last one of a chunk takes any time.
        while not self._skips_frames and num_frames > 1 and not self._is_quick(num_frames):
            num_frames //= 2
        last = min(len(self._frames), at + num_frames)
        while at < last:
            if has_pace:
                if not pace.is_due(now_s):
                    break
                pace.plan_after(self._frames[at])
            at += 1
        return at


LONG_READ_BYTES: Final = 64 * 1024
"""After a read of this size, other sources have their turn. The event loop reads up to 256 KB at once. If a
connection fills that, the loop reads from it up to 32 times before it looks at another one."""


class Reading:
    """Reads from one server only when what has arrived is processed, and no backlog waits.

    ``process`` takes further bytes, here always b"", and when the read arrived (see HostClock.read). It works
    for a limited time. While it returns True, it is called again when the other sources had their turn. It
    must not raise.
    """

    def __init__(self, process: Callable[[bytes, int, int], bool]) -> None:
        self._process = process
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._has_backlog = False
        self._waits_for_turn = False
        self._is_called_soon = False
        self._arrival = (0, 0)  # of what waits for its turn
        self._is_paused = False

    @property
    def is_idle(self) -> bool:
        """Whether everything that arrived has been processed."""
        return not self._waits_for_turn

    def begin(self, transport: asyncio.Transport) -> None:
        """Read from this connection."""
        self._transport = transport
        self._pause_or_resume()  # data may have arrived already

    def set_backlog(self, has_backlog: bool) -> None:
        """Read and process nothing while a backlog waits."""
        self._has_backlog = has_backlog
        if self._waits_for_turn:
            self._continue_soon()
        self._pause_or_resume()

    def wait_for_turn(self, utime: int, steady_us: int) -> None:
        """Let the other sources have their turn, then process what remains of a read, and read on."""
        self._arrival = (utime, steady_us)
        self._waits_for_turn = True
        self._continue_soon()
        self._pause_or_resume()

    def _continue_soon(self) -> None:
        if not self._has_backlog and not self._is_called_soon:
            self._is_called_soon = True
            self._loop.call_soon(self._continue)

    def _continue(self) -> None:
        self._is_called_soon = False
        if not self._has_backlog:  # otherwise set_backlog calls again
            self._waits_for_turn = False
            if self._process(b"", *self._arrival):
                self.wait_for_turn(*self._arrival)
            self._pause_or_resume()

    def _pause_or_resume(self) -> None:
        transport = self._transport
        is_paused = self._has_backlog or self._waits_for_turn
        if transport is None or transport.is_closing() or self._is_paused is is_paused:
            return
        self._is_paused = is_paused
        if is_paused:
            transport.pause_reading()
        else:
            transport.resume_reading()
