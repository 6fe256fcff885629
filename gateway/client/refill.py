"""The threads that request what a subscriber has missed: one for each source of which some is missing."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from gateway.client.completion import Completion, HeldBytes, HistoryAnswer, HistoryRequest
from gateway.errors import QueryError
from gateway.workers import thread_starts

if TYPE_CHECKING:
    from gateway.client.reception import Reception, Series, Source

Ask = Callable[[Any, HistoryRequest], HistoryAnswer]
"""Requests messages of a series, and returns the answer. It blocks. Raises QueryError."""

REPLY_S: Final = 2.0
"""How long an answer may take. The gateway drops those to a peer that reads too slowly."""

_WAIT_S: Final = 0.05
"""When to look again whether the program can take more messages."""


class Refill:
    """Completes the series of a reception; its ``lock`` protects everything here.

    Requests are made with ``ask``. With ``last_s``, each series begins with the messages of these seconds.
    """

    def __init__(
        self, reception: "Reception[Any, Any]", lock: threading.Lock, ask: Ask, last_s: float | None
    ) -> None:
        self._reception = reception
        self._ask = ask
        self._last_s = last_s
        self._held_bytes = HeldBytes()
        self._changed = threading.Condition(lock)
        self._completions: dict[Series, Completion] = {}
        self._due: dict[Source, dict[Series, Completion]] = {}
        self._is_closed = False

    # Under the lock, which the caller holds.

    def add(self, series: "Series", hand_on: Callable[[bytes], object]) -> Completion:
        """Return what completes a series, which hands its messages on."""
        completion = Completion(hand_on, series.check.end, self._held_bytes, self._last_s)
        self._completions[series] = completion
        return completion

    def check(self, series: "Series") -> None:
        """Note that there is something to request of a series."""
        due = self._due.get(series.source)
        if due is None:
            due = {}
            thread = threading.Thread(target=self._run, args=(due,), name="refill", daemon=True)
            with contextlib.suppress(RuntimeError):  # without a thread now, the next message tries again
                thread_starts.start(thread)
                self._due[series.source] = due
        if series not in due:
            due[series] = self._completions[series]
            self._changed.notify_all()

    def reached_utime(self, source: "Source") -> float:
        """Return until when all series of a source are complete; infinite if nothing is missing."""
        due = self._due.get(source)
        incomplete = () if due is None else (each for each in due.values() if each.due_s < math.inf)
        return min((each.reached_utime for each in incomplete), default=math.inf)

    # In any thread.

    @property
    def num_incomplete(self) -> int:
        """How many series miss messages now."""
        with self._changed:
            return sum(each.due_s < math.inf for each in self._completions.values())

    def end(self) -> None:
        """Take nothing more that is published, and request everything until now."""
        with self._changed:
            for series, completion in self._completions.items():
                completion.end(time.monotonic())
                if completion.due_s < math.inf:
                    self.check(series)

    def close(self) -> None:
        """Hand on what is held, and request nothing more."""
        with self._changed:
            self._is_closed = True
            for completion in self._completions.values():
                completion.abandon()
            self._changed.notify_all()

    # In the threads.

    def _run(self, due: "dict[Series, Completion]") -> None:
        while True:
            while not (self._reception.has_room or self._is_closed):
                time.sleep(_WAIT_S)
            with self._changed:
                series = self._wait(due)
                if series is None:
                    return
                completion = due[series]
                request = completion.request()
            answer: HistoryAnswer | None = None
            code = text = ""
            try:
                answer = self._ask(series, request)
            except QueryError as error:
                code, text = error.code, str(error)
            except Exception as defect:  # noqa: BLE001 - what arrives is handed on
                self._reception.failed(defect)
                code = text = "defect"
            with self._changed:
                now_s = time.monotonic()
                if answer is None:
                    completion.fail(request, code, text, now_s)
                else:
                    completion.answer(request, answer, now_s)

    def _wait(self, due: "dict[Series, Completion]") -> "Series | None":
        """Wait until there is something to request, and return of which series; None at the end."""
        while not self._is_closed:
            for series in [each for each, completion in due.items() if completion.due_s == math.inf]:
                del due[series]
            now_s = time.monotonic()
            ready = [series for series in due if due[series].due_s <= now_s]
            if ready:  # so no series is far ahead of the others
                return min(ready, key=lambda series: due[series].reached_utime)
            first_s = min((completion.due_s for completion in due.values()), default=None)
            self._changed.wait(None if first_s is None else first_s - now_s)
        return None
