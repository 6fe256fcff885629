"""What can be seen of a running gateway by those who watch it."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from gateway.outputs.contract import Output
from gateway.source import Source


class Watched(Protocol):
    """A gateway as metrics and health see it; they ask anew each time, for a reload changes it."""

    @property
    def sources(self) -> Sequence[Source]:
        """The sources with their counters."""

    @property
    def outputs(self) -> Sequence[Output]:
        """The outputs."""

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]]:
        """By the output's name, how many of its queries were answered with ok, or with which error."""
