"""How a failure that goes on is told: once loudly, then quietly, and when it is over."""

import logging
import time


class FailureLog:
    """Logs one kind of failure: the first WARNING, its repeats DEBUG with a count, recovery INFO.

    ``subject`` begins every line: "lab", "lcm".
    """

    def __init__(self, logger: logging.Logger, subject: str) -> None:
        self._logger = logger
        self._subject = subject
        self._times = 0
        self._since_s = 0.0

    @property
    def failing(self) -> bool:
        """Whether the last thing told was a failure."""
        return self._times > 0

    def failed(self, text: str) -> None:
        """Tell that it failed, ``text`` saying what happened and what to do."""
        self._times += 1
        if self._times == 1:
            self._since_s = time.monotonic()
            self._logger.warning("%s: %s", self._subject, text)
        else:
            self._logger.debug("%s: %s (failure %d in a row)", self._subject, text, self._times)

    def recovered(self, text: str) -> None:
        """Tell that it works again; says nothing if it had not failed."""
        if self._times:
            seconds = time.monotonic() - self._since_s
            self._logger.info(
                "%s: %s, after %.1f s and %d failures", self._subject, text, seconds, self._times
            )
            self._times = 0
