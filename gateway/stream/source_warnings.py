"""What the streams of a source share, so that a WARNING that concerns several of them is logged once."""

import logging
from collections import deque
from typing import Final

from gateway.logs.failures import FailureLog

MAX_LIMITATIONS: Final = 20
"""How many limitations of a connection are kept, and how many logged ones are remembered."""

logger = logging.getLogger(__name__)


class SourceWarnings:
    """The warnings of one source; ``subject`` begins those about late frames."""

    def __init__(self, subject: object) -> None:
        self.newest_losses_s: dict[str, float] = {}
        """When something was lost last on any of the streams, by cause."""
        self.logged: deque[str] = deque(maxlen=MAX_LIMITATIONS)
        """The limitations and repairs that were logged."""
        self._lateness = FailureLog(logger, subject)
        self._late: set[int] = set()

    def failed(self, stream: int, text: str) -> None:
        """Log that frames are late: as WARNING unless those of another stream are late already."""
        self._late.add(stream)
        self._lateness.failed(text)

    def in_time(self, stream: int, text: str) -> None:
        """Note that no frames of a stream are late any more; log it if that is so for all streams."""
        self._late.discard(stream)
        if not self._late:
            self._lateness.recovered(text)
