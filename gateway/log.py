"""How a failure that goes on is told: once loudly, then quietly, and when it is over."""

import logging
import time


class FailureLog:
    """Logs whether one thing works: the first failure WARNING, its repeats DEBUG, success INFO.

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
        """Tell that it works, and if it had failed, for how long it had not."""
        if self._times:
            seconds = time.monotonic() - self._since_s
            text = f"{text}, after {seconds:.1f} s and {self._times} failures"
            self._times = 0
        self._logger.info("%s: %s", self._subject, text)
