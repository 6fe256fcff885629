"""How the log is written: what goes on failing is told once loudly, and records say what they belong to."""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

FIELDS: Final = ("source", "stream", "peer")
"""What a record may say of itself besides its text: the journal's and JSON's fields."""

HOLD_S: Final = 5.0
"""For FailureLog: how long every message must have gone well for the failures of some to be over."""

_fields: ContextVar[Mapping[str, str]] = ContextVar("log fields")


@contextmanager
def log_fields(**fields: str) -> Iterator[None]:
    """Give every record of the block these of FIELDS, and of the tasks and callbacks that it starts.

    So a connection's records carry them without every call having to name them: the event loop runs
    callbacks in the context that they were registered in.
    """
    token = _fields.set({**_fields.get({}), **fields})
    try:
        yield
    finally:
        _fields.reset(token)


class FieldsFilter(logging.Filter):
    """Puts the fields that are set by ``log_fields`` on each record, as its attributes; for handlers."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Add the fields; every record passes."""
        record.__dict__.update(_fields.get({}))
        return True


class FailureLog:
    """Logs whether one thing works: the first failure WARNING, its repeats DEBUG, success INFO.

    ``subject`` begins every line: "lab", "lcm". What fails by turns, as messages do, is over only when
    it has worked for ``hold_s``: one failure more within it is a repeat.
    """

    def __init__(self, logger: logging.Logger, subject: str, hold_s: float = 0.0) -> None:
        self._logger = logger
        self._subject = subject
        self._hold_s = hold_s
        self._times = 0
        self._first_s = self._last_s = 0.0
        self.failing = False
        """Whether a failure was told that is not over."""

    def failed(self, text: str) -> None:
        """Tell that it failed, ``text`` saying what happened and what to do."""
        self.failing = True
        self._times += 1
        self._last_s = time.monotonic()
        if self._times == 1:
            self._first_s = self._last_s
            self._logger.warning("%s: %s", self._subject, text)
        else:
            self._logger.debug("%s: %s (failure %d in a row)", self._subject, text, self._times)

    def recovered(self, text: str) -> None:
        """Tell that it works, and if it had failed, for how long it had not.

        Within ``hold_s`` of the last failure nothing is told: call again while ``failing``.
        """
        if self._times:
            now_s = time.monotonic()
            if now_s - self._last_s < self._hold_s:
                return
            text = f"{text}, after {now_s - self._first_s:.1f} s and {self._times} failures"
            self._times = 0
            self.failing = False
        self._logger.info("%s: %s", self._subject, text)
