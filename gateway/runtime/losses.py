"""Counts what is lost on one route, by cause, and logs when a loss begins and ends."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from gateway.runtime.failures import HOLD_S, Hold

_MINUTE_S: Final = 60


class Loss(NamedTuple):
    """What was lost for one ``cause``, in total and in the last minute.

    ``frames`` counts the frames that lost at least one message for this cause. It is 0 for what belongs to no
    frame, such as status messages, files and requests. ``age_s`` is the time since the newest loss, and
    ``text`` says what happened then and what to do.
    """

    cause: str
    messages: int
    frames: int
    messages_last_minute: int
    frames_last_minute: int
    age_s: float
    text: str


class _Cause:
    """The counters of one cause."""

    def __init__(self) -> None:
        self.messages = self.frames = 0
        self.period_messages = self.period_frames = 0  # in the current period of loss
        self.logged_level = 0  # the highest level at which it was logged in the current period
        self.newest_s = 0.0
        self.text = ""
        self.frame: object | None = None  # the newest frame that lost a message
        # One entry for each of the last seconds with a loss: the second, messages, frames.
        self.recent: deque[tuple[int, int, int]] = deque(maxlen=_MINUTE_S + 1)

    def add(self, now_s: float, messages: int, frames: int) -> None:
        self.messages += messages
        self.frames += frames
        self.period_messages += messages
        self.period_frames += frames
        self.newest_s = now_s
        second = int(now_s)
        if self.recent and self.recent[-1][0] == second:
            _, messages_before, frames_before = self.recent.pop()
            messages, frames = messages + messages_before, frames + frames_before
        self.recent.append((second, messages, frames))


class Losses:
    """Counts what is lost on one route, for example from a source to an output, and logs it.

    In each period of loss, the first loss for each cause is logged, as WARNING unless ``lost`` says another
    level, and again if a later one has a higher level. The end of the period is logged as INFO with the
    total (see Hold). ``subject`` begins every log message. Any thread may call the methods.
    """

    def __init__(
        self,
        logger: logging.Logger,
        subject: object,
        monotonic: Callable[[], float] = time.monotonic,
        newest_by_cause_s: dict[str, float] | None = None,
    ) -> None:
        # When something was lost last on any of the routes that share this, which log one warning together.
        self._newest_by_cause_s = newest_by_cause_s
        self._logger = logger
        self._subject = subject
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._causes: dict[str, _Cause] = {}
        self._hold = Hold(HOLD_S)
        self._began_s: float | None = None  # when the current period of loss began; None if nothing is lost
        self._newest_s = 0.0

    def lost(
        self, cause: str, text: str, *, messages: int = 1, frames: int = 1, level: int = logging.WARNING
    ) -> None:
        """Count lost ``messages`` that belong to ``frames``. ``text`` says what happened and what to do."""
        now_s = self._monotonic()
        self.check()
        with self._lock:
            counted = self._causes.setdefault(cause, _Cause())
            is_news = counted.logged_level < level
            if is_news:
                counted.logged_level = level
            counted.add(now_s, messages, frames)
            counted.text = text
            self._newest_s = now_s
            if self._began_s is None:
                self._began_s = now_s
                self._hold.begin(now_s)
        is_known = False
        if self._newest_by_cause_s is not None:
            is_known = now_s - self._newest_by_cause_s.get(cause, float("-inf")) < HOLD_S
            self._newest_by_cause_s[cause] = now_s
        if is_news:
            is_repeat = is_known and level == logging.WARNING
            level = logging.DEBUG if is_repeat else level
            self._logger.log(level, "%s: %s", self._subject, text, extra={"kind": cause})

    def message_lost(
        self, cause: str, text: str, frame: object | None, *, level: int = logging.WARNING
    ) -> None:
        """Count one message of ``frame``; None if the message belongs to no frame.

        The messages of one frame come one after the other, so a frame counts once for each cause.
        """
        counted = self._causes.get(cause)
        is_new = frame is not None and (counted is None or counted.frame is not frame)
        self.lost(cause, text, frames=1 if is_new else 0, level=level)
        self._causes[cause].frame = frame

    def check(self) -> None:
        """Log the end of a period of loss if nothing has been lost for long enough. Call it every second."""
        if self._began_s is not None and self._monotonic() - self._newest_s >= self._hold.seconds:
            self._end(f"; no more in the {self._hold.seconds:g} s since then")

    def close(self) -> None:
        """Log the end of a period of loss now, because the route ends. It may be used again."""
        if self._began_s is not None:
            self._end("")

    def report(self) -> list[Loss]:
        """Return what was lost so far, by cause."""
        losses, now_s = [], self._monotonic()
        with self._lock:
            for cause, counted in sorted(self._causes.items()):
                recent = [entry for entry in counted.recent if entry[0] > now_s - _MINUTE_S]
                messages, frames = sum(each[1] for each in recent), sum(each[2] for each in recent)
                totals = (counted.messages, counted.frames, messages, frames)
                losses.append(Loss(cause, *totals, now_s - counted.newest_s, counted.text))
        return losses

    def frames(self, cause: str) -> int:
        """Return how many frames were lost for ``cause`` so far."""
        counted = self._causes.get(cause)
        return 0 if counted is None else counted.frames

    def _end(self, ending: str) -> None:
        with self._lock:
            if self._began_s is None:
                return
            duration_s = self._newest_s - self._began_s
            self._began_s = None
            self._hold.end(self._newest_s + self._hold.seconds)
            counts = []
            for cause, counted in sorted(self._causes.items()):
                if counted.period_messages:
                    counts.append((cause, counted.period_messages, counted.period_frames))
                    counted.period_messages = counted.period_frames = counted.logged_level = 0
        self._logger.info(
            "%s: lost within %.1f s: %s%s", self._subject, duration_s, counts_text(counts), ending
        )


def route_name(source: str, stream: str | None, output: str | None) -> str:
    """Return the name of a route in texts: "lab (3d 6d)" for a stream, "lab to zenoh" for an output."""
    return f"{source} to {output}" if output else f"{source} ({stream})"


def last_minute_text(losses: Iterable[Loss]) -> str:
    """Return what was lost in the last minute; "" if nothing was.

    For example "lost in the last minute: 872 messages of 436 frames (skipped while behind)".
    """
    counts = [(loss.cause, loss.messages_last_minute, loss.frames_last_minute) for loss in losses]
    text = counts_text(count for count in counts if count[1])
    return f"lost in the last minute: {text}" if text else ""


def counts_text(counts: Iterable[tuple[str, int, int]]) -> str:
    """Return a text for each (cause, messages, frames).

    For example "1 message (closed), 872 messages of 436 frames (skipped while behind)".
    """
    texts = []
    for cause, messages, frames in counts:
        of_frames = f" of {frames} frame{'' if frames == 1 else 's'}" if frames else ""
        texts.append(f"{messages} message{'' if messages == 1 else 's'}{of_frames} ({cause})")
    return ", ".join(texts)
