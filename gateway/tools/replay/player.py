"""The thread that replays a take: it reads each message, waits until it is due, and publishes it."""

import threading
from collections.abc import Callable, Generator
from contextlib import closing
from typing import Final, Protocol

from gateway.takes.files.reader import TakeReader
from gateway.tools.replay.control import PlayerControl
from gateway.tools.replay.pace import Pace, PlayerClock
from gateway.tools.replay.play_list import Entry, SeekIndex, Selection, TakePasses
from gateway.tools.replay.timeline import MAX_GAP_S, Jump

_FINE_S: Final = 0.005
"""A wait for a condition may end this much too late, so the last part of a wait is slept."""

_PREVIEW_US: Final = 100_000

_PASS_S: Final = 0.01
"""A repeated take begins again after this time at the earliest, however short it is."""


class MessageSink(Protocol):
    """Takes the messages of a replay, such as a Publication."""

    def publish(self, source: str, key: str, message: bytes) -> None:
        """Take one message; ``key`` is that of a TakeMessage."""


class Player:
    """Replays a take with ``publication``, in a thread, until its end or ``control.stop``.

    ``rate`` is how many times as fast as recorded; None is as fast as possible. If it ``is_watched``, it
    waits at the end for a seek or the stop, and where it begins during a pause, it publishes 0.1 s, so that a
    viewer shows that moment. ``on_jump`` is called in the thread where the time of the messages jumps. The
    same thread reads the take, which takes 3 µs per message: two threads that run Python would keep each
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
        self.control = PlayerControl(selection.start_us, self._clock)
        """Where the replay is, and what is asked of it."""
        self.pace = None if rate is None else Pace(rate, self._clock.now_s)
        """When messages are due, and how late they were; None if it is as fast as possible."""
        self.num_messages = 0
        """How many messages were replayed."""
        self.num_passes = 0
        """How often the take was replayed to its end."""
        self.seconds = 0.0
        """How long the thread ran; known after its end."""
        self.error: BaseException | None = None
        """What ended the replay, if it did not end by itself."""
        self.is_repeated = is_repeated
        """Whether it begins again at the end. It may be changed at any time."""
        self._is_watched = is_watched
        self._publication = publication
        index = SeekIndex() if is_watched else None
        self._passes = TakePasses(reader, selection, max_gap_s=max_gap_s, on_jump=on_jump, index=index)
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def join(self, timeout_s: float) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    # In the thread.

    def _run(self) -> None:
        started_s = self._clock.now_s()
        try:
            start_us: int | None = self.control.start_us
            while start_us is not None:
                start_us = self._next_start(start_us)
        except BaseException as error:  # noqa: BLE001 - the waiting thread raises it
            self.error = error
        finally:
            self.seconds = self._clock.now_s() - started_s

    def _next_start(self, start_us: int) -> int | None:
        """Replay from a position on; return where to go on, None if this was the end."""
        control = self.control
        with closing(self._passes.entries(start_us, reports_jumps=not self.num_passes)) as entries:
            is_complete = self._play(entries, start_us)
        if control.is_stopping:
            return None
        if not is_complete:
            return control.take_seek()
        control.drop_seek()
        self.num_passes += 1
        if not self.num_messages:
            raise self._passes.nothing_selected()
        if not self.is_repeated:
            return control.wait_at_end() if self._is_watched else None
        self._clock.sleep(_PASS_S)
        return control.start_us

    def _play(self, entries: Generator[Entry], start_us: int) -> bool:
        """Publish messages when they are due; return False if something else is to be done before the end."""
        publish, pace, control = self._publication.publish, self.pace, self.control
        preview_end_us = start_us + _PREVIEW_US if self._is_watched and control.is_paused else start_us
        is_begun = False
        for position_us, source, key, message in entries:
            is_preview = position_us < preview_end_us
            if control.must_attend and not is_preview and not self._attend():
                return False
            if pace is not None and not is_preview:
                if not is_begun and key != "parameters":
                    is_begun = True
                    pace.start(max(start_us, preview_end_us))
                if is_begun and not self._wait(pace, position_us):
                    return False
            publish(source, key, message)
            control.position_us = position_us
            self.num_messages += 1
        return True

    def _wait(self, pace: Pace, position_us: int) -> bool:
        """Wait until a position is due; return False if something else is to be done first."""
        while (wait_s := pace.remaining_s(position_us)) > 0:
            if wait_s <= _FINE_S:
                self._clock.sleep(wait_s)
            else:
                self.control.wait(wait_s - _FINE_S / 2)
                if self.control.must_attend and not self._attend():
                    return False
            pace.waited(position_us)
        pace.lateness.add(-wait_s)
        return True

    def _attend(self) -> bool:
        """Pause until the replay is to continue; return False if it is to stop or to go elsewhere."""
        began_s = self._clock.now_s()
        is_continued = self.control.wait_to_continue()
        paused_s = self._clock.now_s() - began_s
        rate = self.control.take_rate()
        if self.pace is not None:
            self.pace.shift(paused_s)
            if rate is not None:
                self.pace.change(rate, self.control.position_us)
        return is_continued
