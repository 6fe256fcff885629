"""The thread that replays a take: it reads each message, waits until it is due, and publishes it."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import closing
from typing import Final, Protocol

from gateway.errors import SelectionError
from gateway.takes.files.reader import TakeReader
from gateway.tools.replay.play_list import Entry, SeekIndex, Selection, play_list
from gateway.tools.replay.timeline import MAX_GAP_S, Jump, ReplayTimeline

_BINS_PER_E: Final = 50
"""Bins of the lateness differ by 2 %."""


class Pace:
    """When each position of a take is due: on an absolute schedule, so that no error adds up.

    ``rate`` is how many times as fast as recorded. ``monotonic`` returns the time in s.
    """

    def __init__(self, rate: float, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._s_per_us = 1e-6 / rate
        self._monotonic = monotonic
        self._start_s = 0.0  # when position 0 is due

    def start(self, position_us: int) -> None:
        """Let ``position_us`` be due now, and later ones after it."""
        self._start_s = self._monotonic() - position_us * self._s_per_us

    def change(self, rate: float, position_us: int) -> None:
        """Continue at another rate, with ``position_us`` due now."""
        self._s_per_us = 1e-6 / rate
        self.start(position_us)

    def shift(self, delay_s: float) -> None:
        """Let everything be due later."""
        self._start_s += delay_s

    def due_s(self, position_us: int) -> float:
        """Return when a position is due, on the monotonic clock."""
        return self._start_s + position_us * self._s_per_us


class Lateness:
    """How late messages were: a histogram with bins of 2 %."""

    def __init__(self) -> None:
        self.num_messages = 0
        self.max_s = 0.0
        self._counts: Counter[int] = Counter()  # by bin

    def add(self, late_s: float) -> None:
        """Count a message."""
        self.num_messages += 1
        self.max_s = max(self.max_s, late_s)
        late_us = late_s * 1e6
        self._counts[int(_BINS_PER_E * math.log(late_us)) + 1 if late_us > 1 else 0] += 1

    def quantile_s(self, fraction: float) -> float:
        """Return the lateness that this part of the messages does not exceed, within 2 %; 0.0 without any."""
        rest = fraction * self.num_messages
        for index, count in sorted(self._counts.items()):
            rest -= count
            if rest <= 0:
                return min(math.exp(index / _BINS_PER_E) * 1e-6, self.max_s)
        return self.max_s


_FINE_S: Final = 0.005
"""A wait for a condition may end this much too late, so the last part of a wait is slept."""

STALL_S: Final = 1.0
"""A process that was stopped for longer does not catch up: the rest of the take is played later."""

_PREVIEW_US: Final = 100_000

_PASS_S: Final = 0.01
"""A repeated take begins again after this time at the earliest, however short it is."""


class MessageSink(Protocol):
    """Takes the messages of a replay, such as a Publication."""

    def publish(self, source: str, key: str, message: bytes) -> None:
        """Take one message; ``key`` is that of a TakeMessage."""


class PlayerClock:
    """The time of a player; tests replace it."""

    def now_s(self) -> float:
        """Return the time on the monotonic clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let the thread sleep."""
        time.sleep(seconds)

    def wait(self, changed: threading.Condition, seconds: float | None) -> None:
        """Wait until ``changed`` is notified, or for so long."""
        changed.wait(seconds)


class Player:
    """Replays a take with ``publication``, in a thread, until its end or ``stop``.

    ``rate`` is how many times as fast as recorded; None is as fast as possible. If it ``is_watched``, it
    waits at the end until ``stop`` or a seek, and where it begins during a pause, it publishes 0.1 s, so that
    a viewer shows that moment. ``on_jump`` is called in the thread where the time of the messages jumps.
    The same thread reads the take, which takes 3 µs per message: two threads that run Python would keep each
    other waiting. The system reads the file ahead.
    """

    def __init__(  # noqa: PLR0913 - most are options of the command
        self,
        reader: TakeReader,
        selection: Selection,
        publication: MessageSink,
        *,
        rate: float | None = 1.0,
        is_repeated: bool = False,
        is_watched: bool = False,
        max_gap_s: float = MAX_GAP_S,
        on_jump: Callable[[Jump], None] = lambda _jump: None,
        clock: PlayerClock | None = None,
    ) -> None:
        self._clock = PlayerClock() if clock is None else clock
        self.lateness = Lateness()
        self.position_us = selection.start_us
        """Where in the take the newest message is."""
        self.num_messages = 0
        """How many messages were replayed."""
        self.num_passes = 0
        """How often the take was replayed to its end."""
        self.stalled_s = 0.0
        """For how long the process was stopped, or a disk or an output did not return."""
        self.error: BaseException | None = None
        """What ended the replay, if it did not end by itself."""
        self._reader = reader
        self._selection = selection
        self._publication = publication
        self._pace = None if rate is None else Pace(rate, self._clock.now_s)
        self.is_repeated = is_repeated
        """Whether it begins again at the end. It may be changed at any time."""
        self.is_at_end = False
        """Whether it waits at the end."""
        self._is_watched = is_watched
        self._index = SeekIndex() if is_watched else None  # with it, not each pass finds all damage
        self._max_gap_s = max_gap_s
        self._on_jump = on_jump
        self.seconds = 0.0
        """How long the thread ran; known after its end."""
        self._begun_s = 0.0  # when the present wait, or the present message, was to begin
        self._changed = threading.Condition()  # of the next five
        self.is_paused = False
        """Whether the replay pauses; see ``pause``."""
        self._is_stopping = False
        self._seek_us: int | None = None
        self._rate: float | None = None  # to be changed to
        self._must_attend = False  # whether one of these four is set; read for each message
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def pause(self, is_paused: bool) -> None:
        """Pause, or continue at the same place."""
        with self._changed:
            self.is_paused = is_paused
            self._notify()

    def seek(self, delta_us: int) -> None:
        """Continue at another place, this far from the present one."""
        with self._changed:
            self.seek_to((self.position_us if self._seek_us is None else self._seek_us) + delta_us)

    def seek_to(self, position_us: int) -> None:
        """Continue at a position, in µs from the first message of the take."""
        with self._changed:
            self._seek_us = max(self._selection.start_us, position_us)
            self._notify()

    def set_rate(self, rate: float) -> None:
        """Continue at another rate. It must have been created with a rate."""
        with self._changed:
            self._rate = rate
            self._notify()

    def stop(self) -> None:
        """End the thread soon; ``join`` waits for it."""
        with self._changed:
            self._is_stopping = True
            self._notify()

    def _notify(self) -> None:
        is_waiting = self._seek_us is not None or self._rate is not None
        self._must_attend = self._is_stopping or self.is_paused or is_waiting
        self._changed.notify()

    def join(self, timeout_s: float) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    # In the thread.

    def _run(self) -> None:
        started_s = self._clock.now_s()
        try:
            start_us: int | None = self._selection.start_us
            while start_us is not None:
                start_us = self._next_start(start_us)
        except BaseException as error:  # noqa: BLE001 - the waiting thread raises it
            self.error = error
        finally:
            self.seconds = self._clock.now_s() - started_s

    def _next_start(self, start_us: int) -> int | None:
        """Replay from a position on; return where to go on, None if this was the end."""

        def report(jump: Jump) -> None:
            if not self.num_passes and jump.position_us >= start_us:
                self._on_jump(jump)

        timeline = ReplayTimeline(self._max_gap_s, report)
        with closing(play_list(self._reader, self._selection, timeline, start_us, self._index)) as entries:
            is_complete = self._play(entries, start_us)
        with self._changed:
            if self._is_stopping:
                return None
            seek_us, self._seek_us = self._seek_us, None
            if not is_complete and seek_us is not None:
                self.position_us = seek_us
            self._notify()
        if not is_complete:
            return seek_us
        self.num_passes += 1
        if not self.num_messages:
            raise SelectionError(
                f"{self._reader.path} has no messages to replay with these options; "
                f"check --source ({', '.join(self._reader.source_names)}), --component, --from and --to"
            )
        if not self.is_repeated:
            return self._wait_at_end() if self._is_watched else None
        self._clock.sleep(_PASS_S)
        return self._selection.start_us

    def _wait_at_end(self) -> int | None:
        """Wait for a seek, and return its position; None if the replay is to stop."""
        with self._changed:
            self.is_at_end = True
            while not (self._is_stopping or self._seek_us is not None):
                self._clock.wait(self._changed, None)
            self.is_at_end = False
            seek_us, self._seek_us = self._seek_us, None
            self._notify()
            return None if self._is_stopping else seek_us

    def _play(self, entries: Generator[Entry], start_us: int) -> bool:
        """Publish messages when they are due; return False if something else is to be done before the end."""
        publish, pace = self._publication.publish, self._pace
        preview_end_us = start_us + _PREVIEW_US if self._is_watched and self.is_paused else start_us
        is_begun = False
        for position_us, source, key, message in entries:
            is_preview = position_us < preview_end_us
            if self._must_attend and not is_preview and not self._attend():
                return False
            if pace is not None and not is_preview:
                if not is_begun and key != "parameters":
                    is_begun = True
                    pace.start(max(start_us, preview_end_us))
                    self._begun_s = self._clock.now_s()
                if is_begun and not self._wait(pace, position_us):
                    return False
            publish(source, key, message)
            self.position_us = position_us
            self.num_messages += 1
        return True

    def _wait(self, pace: Pace, position_us: int) -> bool:
        """Wait until a position is due; return False if something else is to be done first."""
        now_s = self._now_s(pace)
        while (wait_s := pace.due_s(position_us) - now_s) > 0:
            if wait_s <= _FINE_S:
                self._clock.sleep(wait_s)
            else:
                with self._changed:
                    if not self._must_attend:
                        self._clock.wait(self._changed, wait_s - _FINE_S / 2)
                if self._must_attend and not self._attend():
                    return False
            self._begun_s = max(self._begun_s, min(pace.due_s(position_us), self._clock.now_s()))
            now_s = self._now_s(pace)
        self.lateness.add(-wait_s)
        return True

    def _now_s(self, pace: Pace) -> float:
        """Return the time; if the process stood still since ``_begun_s``, let all the rest be due later."""
        now_s = self._clock.now_s()
        stalled_s = now_s - self._begun_s
        if stalled_s > STALL_S:
            pace.shift(stalled_s)
            self.stalled_s += stalled_s
        self._begun_s = now_s
        return now_s

    def _attend(self) -> bool:
        """Pause until the replay is to continue; return False if it is to stop or to go elsewhere."""
        began_s = self._clock.now_s()
        with self._changed:
            while self.is_paused and not self._is_stopping and self._seek_us is None:
                self._clock.wait(self._changed, None)
            is_continued = not self._is_stopping and self._seek_us is None
            rate, self._rate = self._rate, None
            self._notify()
        paused_s = self._clock.now_s() - began_s
        if self._pace is not None:
            self._pace.shift(paused_s)
            if rate is not None:
                self._pace.change(rate, self.position_us)
        self._begun_s += paused_s
        return is_continued
