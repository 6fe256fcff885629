"""What `record` has received: the sources, and the messages of each of their keys."""

import math
import time
from typing import Final

from gateway.subscriber.series import Series, Source

_WAIT_S: Final = 1.5
"""How long the messages of a new source wait for its description; each second brings a status."""


class RecordedSeries(Series):
    """The messages of one key of a source."""

    source: "RecordedSource"

    def __init__(self, source: "RecordedSource", key: str, channel: str, *, is_recorded: bool) -> None:
        super().__init__(source, key, channel)
        self.is_recorded = is_recorded
        """Whether its messages are recorded. Those of others only describe the source."""
        self.num_refused = 0
        """How many of them were not written, because too many waited for the disk."""
        self.num_refused_bytes = 0

    def refuse(self, message: bytes) -> None:
        """Count a message that is not written."""
        self.num_refused += 1
        self.num_refused_bytes += len(message)


class RecordedSource(Source):
    """A source of the recording. ``channels`` is the beginning of its channels in the file."""

    def __init__(self, name: str, channels: str) -> None:
        super().__init__(name, channels)
        self.first_parameters: bytes | None = None
        """The first one, which belongs to the description."""
        self.has_made_first = False
        """Whether this program has made that message, and no gateway."""
        self.is_described = False
        """Whether its description is in the file. Before that, its messages wait."""

    @property
    def is_waiting(self) -> bool:
        """Whether something that the description needs is still to come."""
        is_complete = self.heard_s is not None and not super().is_waiting
        return not (self.is_described or is_complete or time.monotonic() - self.found_s > _WAIT_S)

    def stop_waiting(self) -> None:
        """Describe the source by what is known now."""
        self.found_s = -math.inf

    @property
    def num_data(self) -> int:
        """How many messages of frames have arrived to be recorded."""
        return sum(each.num_messages for each in self.series if each.has_data and each.is_recorded)
