"""The threads that request what a subscriber has missed: one for each source of which some is missing."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

from gateway.client.arrived_run import HeldBytes
from gateway.client.completion import Completion
from gateway.client.history_requests import REPLY_S, RETRY_CODES, Completeness, HistoryAnswer, HistoryRequest
from gateway.client.request_timing import NOBODY_S, PATIENCE_S, RETRY_S
from gateway.client.sources import ReceivedSeries, ReceivedSource
from gateway.errors import QueryError
from gateway.runtime.workers import thread_starts

Ask = Callable[[Any, HistoryRequest, float], HistoryAnswer]
"""Requests messages of a series, and returns the answer. The last argument is how many seconds it may take.

It blocks. Raises QueryError.
"""

FindSeries = Callable[[Any, float, float], "list[KeptSeries]"]
"""Returns the series of a source of which the gateway has messages of the last seconds, and that are wanted.

The arguments are the source, the number of these seconds, and how many seconds it may take. It blocks. Raises
QueryError.
"""

_LOOK_S: Final = 2.0
"""How often the keys are looked up of which a first message may be missing: each time costs a query."""

_MARGIN_S: Final = 1.0
"""How much longer than it is known a source may have been heard."""

SILENT_S: Final = 2.5
"""If nothing of a source has arrived for so long, not even its status, the connection is lost."""

_WAIT_S: Final = 0.05
"""When to look again whether the program can take more messages."""

END_S: Final = 5.0
"""How long the end waits while nothing of what is missing comes: the gateway may have ended before."""


class KeptSeries(NamedTuple):
    """A series of which the gateway keeps messages, with the number and the time of the newest one."""

    series: Any
    newest: int
    newest_utime: int


class RefilledReception(Protocol):
    """What a Refill needs to know of the reception whose series it completes."""

    @property
    def has_room(self) -> bool:
        """Whether more messages can be taken now. Nothing is requested otherwise."""

    def failed(self, defect: Exception) -> None:
        """Note a defect in this program."""


class Refill:
    """Completes the series of a reception; its ``lock`` protects everything here.

    Requests are made with ``ask``. ``find`` finds the series that nothing arrives of: those with messages in
    the last seconds, if these are wanted; and after an outage, and at the end, those whose first or last
    message may have fallen into it. ``monotonic`` is the clock of the reception.
    """

    def __init__(
        self,
        reception: RefilledReception,
        lock: threading.Lock,
        ask: Ask,
        find: FindSeries,
        completeness: Completeness,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.completeness = completeness
        self._monotonic = monotonic
        self._reception = reception
        self._ask = ask
        self._find = find
        self._held_bytes = HeldBytes()
        self._changed = threading.Condition(lock)
        self._completions: dict[ReceivedSeries, Completion] = {}
        self._due: dict[ReceivedSource, dict[ReceivedSeries, Completion]] = {}
        self._look_s: dict[ReceivedSource, float] = {}  # when to look for series of which nothing has arrived
        self._looked_s: dict[ReceivedSource, float] = {}
        self._helped_s = -math.inf  # when an answer has brought something
        self._is_ending = self._is_closed = False

    # Under the lock, which the caller holds.

    def add(self, series: ReceivedSeries, hand_on: Callable[[bytes], object]) -> Completion:
        """Return what completes a series, which hands its messages on."""
        completion = Completion(
            *(hand_on, series.check, self._held_bytes, self.completeness), is_steady=series.key == "status"
        )
        self._completions[series] = completion
        return completion

    def begin(self, source: ReceivedSource) -> None:
        """Note that there is a source, which may have had messages in the last seconds."""
        if self.completeness.last_s is not None:
            self._due_of(source)

    def _due_of(self, source: ReceivedSource) -> dict[ReceivedSeries, Completion]:
        """Return the series of a source of which something is to be requested, by a thread of the source."""
        due = self._due.get(source)
        if due is None:
            due = {}
            thread = threading.Thread(target=self._run, args=(source, due), name="refill", daemon=True)
            with contextlib.suppress(RuntimeError):  # without a thread now, the next message tries again
                thread_starts.start(thread)
                self._due[source] = due
        return due

    def look_after_silence(self, source: ReceivedSource) -> None:
        """Note that something of a source arrives again after SILENT_S without anything.

        The numbers of the keys that are heard may go on by chance although the gateway was started again, and
        others may have had all of their messages meanwhile. The gateway is asked a little later: Zenoh may
        have to find it first.
        """
        if self.completeness.is_complete:
            self._due_of(source)
            self._look_s.setdefault(source, self._monotonic() + _LOOK_S)
            self._changed.notify_all()

    def check(self, series: ReceivedSeries) -> None:
        """Note that there is something to request of a series."""
        due = self._due_of(series.source)
        if series not in due:
            due[series] = self._completions[series]
            self._changed.notify_all()

    def reached_utime(self, source: ReceivedSource) -> float:
        """Return until when all series of a source are complete; infinite if nothing is missing."""
        due = self._due.get(source)
        incomplete = () if due is None else (each for each in due.values() if each.due_s < math.inf)
        return min((each.reached_utime for each in incomplete), default=math.inf)

    # In any thread.

    @property
    def num_incomplete(self) -> int:
        """How many series miss messages now, or may do so."""
        with self._changed:
            num_looks = len(self._look_s) if self._is_ending else 0
            return num_looks + sum(each.due_s < math.inf for each in self._completions.values())

    def end(self) -> None:
        """Take nothing more that is published, and request everything until now."""
        with self._changed:
            self._is_ending = True
            for series, completion in self._completions.items():
                completion.end(self._monotonic())
                if completion.due_s < math.inf:
                    self.check(series)
                    if self.completeness.is_complete:
                        self._look_s[series.source] = -math.inf
            self._changed.notify_all()

    def wait_for_end(self, interval_s: float, tick: Callable[[], object] = lambda: None) -> None:
        """After ``end``, wait until nothing is missing, or nothing of it has come for END_S.

        A computer that is too busy may need much longer for all of it. As long as messages come, to give up
        would lose what is there; but not for longer than PATIENCE_S in all. ``tick`` is called every
        ``interval_s``.
        """
        least, changed_s = self.num_incomplete, self._monotonic()
        last_s = changed_s + PATIENCE_S
        while (num_incomplete := self.num_incomplete) > 0:
            now_s = self._monotonic()
            if num_incomplete < least:
                least, changed_s = num_incomplete, now_s
            if now_s >= min(max(changed_s, self._helped_s) + END_S, last_s):
                return
            time.sleep(interval_s)
            tick()

    def close(self) -> None:
        """Hand on what is held, and request nothing more."""
        with self._changed:
            self._is_closed = True
            for completion in self._completions.values():
                completion.abandon()
            self._changed.notify_all()

    # In the threads.

    def _run(self, source: ReceivedSource, due: dict[ReceivedSeries, Completion]) -> None:
        begin_s = self._monotonic()
        silent_s = self._begin_silent(source, begin_s)
        while True:
            while not (self._reception.has_room or self._is_closed):
                time.sleep(_WAIT_S)
            with self._changed:
                series = self._wait(source, due, silent_s)
                if self._is_closed:
                    return
            if series is not None:
                self._request(series, due[series])
            elif self._monotonic() >= silent_s:
                silent_s = self._begin_silent(source, begin_s)
            else:
                self._look(source)

    def _request(self, series: ReceivedSeries, completion: Completion) -> None:
        """Request what a series misses, and give it the answer."""
        source = series.source
        with self._changed:
            if completion.due_s == math.inf:
                return  # it has arrived
            request, reply_s = completion.request(), completion.reply_s(self._monotonic())
            # At the end, one look is enough: each would find what was published since, without end.
            if self.completeness.is_complete and not self._is_ending:
                self._look_s.setdefault(source, self._looked_s.get(source, -math.inf) + _LOOK_S)
        answer: HistoryAnswer | None = None
        code = text = ""
        try:
            answer = self._ask(series, request, reply_s)
        except QueryError as error:
            code, text = error.code, str(error)
        except Exception as defect:  # noqa: BLE001 - what arrives is handed on
            self._reception.failed(defect)
            code = text = "defect"
        with self._changed:
            now_s = self._monotonic()
            if answer is None:
                completion.fail(request, code, text, now_s, is_connected=_is_connected(source, now_s))
            else:
                before = completion.reached_utime
                completion.answer(request, answer, now_s)
                if completion.reached_utime != before:
                    self._helped_s = now_s

    def _begin_silent(self, source: ReceivedSource, begin_s: float) -> float:
        """Begin the series of a source that had messages in the last seconds, and may have none now.

        Returns when to try again: infinite if that is not needed, or nobody has answered since ``begin_s``
        for as long as other requests are repeated. Until then, no message says that there is such a series.
        """
        last_s, patience_s = self.completeness.last_s, self.completeness.patience_s
        if last_s is None:
            return math.inf
        found: list[KeptSeries] = []
        code = ""
        try:
            found = self._find(source, last_s, min(REPLY_S, patience_s or REPLY_S))
        except QueryError as error:
            code = error.code
        except Exception as defect:  # noqa: BLE001 - as in _request
            self._reception.failed(defect)
        with self._changed:
            now_s = self._monotonic()
            for series, *_ in found:
                completion = self._completions.get(series)
                if completion is not None:
                    completion.begin(now_s)
                    self.check(series)
        is_nobody = code == "no-gateway" and _is_connected(source, now_s)
        is_over = now_s - begin_s >= (NOBODY_S if is_nobody else PATIENCE_S)
        return math.inf if is_over or code not in RETRY_CODES else now_s + RETRY_S

    def _look(self, source: ReceivedSource) -> None:
        """Look for messages of a source that nothing which arrives shows: the first of a key, or the last."""
        begin_s = self._monotonic()
        found: list[KeptSeries] = []
        is_over = True
        try:
            found = self._find(source, begin_s - source.found_s + _MARGIN_S, REPLY_S)
        except QueryError as error:
            is_over = error.code not in RETRY_CODES or error.code == "no-gateway"
        except Exception as defect:  # noqa: BLE001 - as in _request
            self._reception.failed(defect)
        with self._changed:
            now_s = self._monotonic()
            self._looked_s[source] = begin_s
            if is_over or not self._is_ending:  # the next gap looks again
                self._look_s.pop(source, None)
            else:
                self._look_s[source] = now_s + RETRY_S
            first_utime = source.first_utime
            for series, newest, utime in found:
                completion = self._completions.get(series)
                if completion is None or first_utime is None or utime < first_utime:
                    continue
                if not completion.has_begun:
                    completion.begin_since(first_utime, now_s)
                    if self._is_ending:
                        completion.end(now_s)
                completion.notice(newest, utime, now_s)
                if completion.due_s < math.inf:
                    self.check(series)

    def _wait(
        self, source: ReceivedSource, due: dict[ReceivedSeries, Completion], silent_s: float
    ) -> ReceivedSeries | None:
        """Wait until there is something to request, and return of which series; None to look for some.

        ``silent_s`` is when to look for those that are silent now.
        """
        while not self._is_closed:
            now_s = self._monotonic()
            for completion in due.values():
                completion.expire(now_s)
            for series in [each for each, completion in due.items() if completion.due_s == math.inf]:
                del due[series]
            ready = [series for series in due if due[series].due_s <= now_s]
            if ready:  # so no series is far ahead of the others
                return min(ready, key=lambda series: due[series].reached_utime)
            look_s = min(silent_s, self._look_s.get(source, math.inf))
            if look_s <= now_s:
                return None
            first_s = min([look_s, *(completion.due_s for completion in due.values())])
            self._changed.wait(None if first_s == math.inf else first_s - now_s)
        return None


def _is_connected(source: ReceivedSource, now_s: float) -> bool:
    """Whether something of a source has arrived just now, at least its status, or nothing ever has."""
    return now_s - (source.heard_s or now_s) <= SILENT_S
