"""Which questions of peers an output answers: limits of their rate, their number and their bytes.

A question is admitted or refused where it arrives, in a thread of the output's library. So a flood of
questions costs the event loop no more than the questions that are answered.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Self

from gateway.errors import QueryError
from gateway.runtime.failures import DefectLog
from gateway.runtime.token_bucket import TokenBucket

MAX_KEYS: Final = 256
"""Of how many keys the rate is known. The key that was asked for least recently is forgotten first."""

MAX_STOPS: Final = 64
"""How many questions that stop something are admitted although a limit refuses others."""

REFUSALS_PER_S: Final = 500.0
"""How many refusals a second are sent to peers. Further questions get no reply at all."""

NO_REPLY: Final = "no-reply"
"""The result of a question that got no reply."""


class QueryLimits(NamedTuple):
    """The limits of one output. ``output`` and ``key_setting`` name its settings in texts for users.

    ``key_setting`` limits the questions about one key, whatever that is on this output.
    """

    output: str
    key_setting: str
    per_s: float
    per_key_per_s: float
    reply_bytes_per_s: float
    pending: int

    @classmethod
    def of(cls, output: str, key_setting: str, settings: Any, pending: int) -> Self:
        """Return the limits that the ``settings`` of an output have."""
        return cls(
            *(output, key_setting, settings.max_queries_per_s, getattr(settings, key_setting)),
            reply_bytes_per_s=settings.max_reply_bytes_per_s,
            pending=pending,
        )


class Refusal(NamedTuple):
    """Why a question is not answered. ``cause`` is rate or queue, for counters.

    The peer gets ``error`` only if ``is_sent``; otherwise, it gets no reply.
    """

    error: QueryError
    cause: str
    is_sent: bool


class QueryAdmission:
    """Admits or refuses questions, and counts them by result. Any thread may call the methods."""

    def __init__(self, limits: QueryLimits, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._limits = limits
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._total = TokenBucket(limits.per_s, monotonic=monotonic)
        self._keys: dict[str, TokenBucket] = {}  # the one that was asked for least recently is first
        self._bytes = TokenBucket(limits.reply_bytes_per_s, monotonic=monotonic)
        self._long_bytes = TokenBucket(limits.reply_bytes_per_s, monotonic=monotonic)
        self._refusals = TokenBucket(REFUSALS_PER_S, monotonic=monotonic)
        self.num_pending = 0
        """How many questions have been admitted and are not finished."""
        self._results: dict[str, Counter[str]] = {}  # by source

    @property
    def results(self) -> dict[str, Counter[str]]:
        """By source, the number of questions by result: ok, the code of the error, or NO_REPLY."""
        with self._lock:
            return {source: results.copy() for source, results in self._results.items()}

    def admit(self, source: str, key: str, *, is_stop: bool = False) -> Refusal | None:
        """Admit a question about ``key``, until ``finished`` is called for it; or return why not.

        It is counted for ``source``, one of the gateway's. One that stops something is admitted beyond all
        limits but MAX_STOPS: a recording must not go on because somebody else asks too much.
        """
        with self._lock:
            bucket = self._keys.pop(key, None)
            if bucket is None:
                bucket = TokenBucket(self._limits.per_key_per_s, monotonic=self._monotonic)
                if len(self._keys) >= MAX_KEYS:
                    del self._keys[next(iter(self._keys))]
            self._keys[key] = bucket
            has_room = self.num_pending < self._limits.pending + MAX_STOPS
            refusal = None if is_stop and has_room else self._refusal(bucket)
            if refusal is None:
                self._total.take()
                bucket.take()
                self.num_pending += 1
            else:
                self._count_result(source, refusal.error.code if refusal.is_sent else NO_REPLY)
            return refusal

    def finished(self, source: str, result: str) -> None:
        """Count the result of a question that was admitted; "" if it has none."""
        with self._lock:
            self.num_pending -= 1
            if result:
                self._count_result(source, result)

    def _count_result(self, source: str, result: str) -> None:
        self._results.setdefault(source, Counter())[result] += 1

    def count(self, num_answers: int) -> None:
        """Count further answers to a question that has more than one."""
        with self._lock:
            self._total.take(num_answers)

    def check_reply(self, num_bytes: int, *, is_long: bool = False) -> None:
        """Count a reply of this size. Raise QueryError if it must not be sent now.

        Long replies are counted apart, or a C3D file would keep all others waiting.
        """
        with self._lock:
            if (self._long_bytes if is_long else self._bytes).try_take(num_bytes):
                return
        limits = self._limits
        raise QueryError(
            f"all replies of a second may have {limits.reply_bytes_per_s:g} bytes together; ask less often, "
            f"or raise {limits.output}.max_reply_bytes_per_s in the gateway's configuration",
            code="rate",
        )

    def _refusal(self, bucket: TokenBucket) -> Refusal | None:
        if self.num_pending >= self._limits.pending:
            error = QueryError("the gateway has too many queries; try again", code="busy")
            return Refusal(error, "queue", self._refusals.try_take())
        for allowed, per_s, setting, what in (
            (self._total, self._limits.per_s, "max_queries_per_s", "in total"),
            (bucket, self._limits.per_key_per_s, self._limits.key_setting, "like this one"),
        ):
            if allowed.left <= 0:
                text = (
                    f"the gateway answers {per_s:g} queries a second {what}; ask less often, subscribe "
                    f"instead, or raise {self._limits.output}.{setting} in the gateway's configuration"
                )
                return Refusal(QueryError(text, code="rate"), "rate", self._refusals.try_take())
        return None


class QueryDefects:
    """Logs defects of one output with ``logger``, each once for each source. Any thread may call it."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._logs: dict[str, DefectLog] = {}  # by source

    def log(self, source: str, defect: BaseException, query: str) -> QueryError:
        """Log the defect that a query about ``source`` met; return the error for its peer."""
        self._logs.setdefault(source, DefectLog(self._logger, source)).log(defect, text=query)
        return QueryError(f"a defect in the gateway: {defect!r}", code="defect")
