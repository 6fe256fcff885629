"""Results of checks; the doctor reports them."""

from enum import StrEnum
from typing import NamedTuple


class Result(StrEnum):
    """The result of a check. The values appear in the doctor's JSON."""

    PASSING = "green"
    FAILING = "red"
    NOT_TESTED = "not tested"


class Finding(NamedTuple):
    """The result of one check.

    ``subject`` is what was checked: the name of a source, or for example "zenoh". ``check`` names the check.
    ``found`` says what was found, or why the check was not made. ``remedy`` says what to do if it fails.
    """

    subject: str
    check: str
    result: Result
    found: str
    remedy: str = ""


class Subject(NamedTuple):
    """Something that is checked: a source, an output or this computer. Creates its findings."""

    name: str

    def passing(self, check: str, found: str) -> Finding:
        """Return a passing finding."""
        return Finding(self.name, check, Result.PASSING, found)

    def failing(self, check: str, found: str, remedy: str) -> Finding:
        """Return a failing finding and what to do about it."""
        return Finding(self.name, check, Result.FAILING, found, remedy)

    def not_tested(self, check: str, reason: str) -> Finding:
        """Return a finding for a check that could not be made."""
        return Finding(self.name, check, Result.NOT_TESTED, reason)


class MessageLoad(NamedTuple):
    """The rate of one component's messages, and the size of the largest."""

    rate_hz: float
    largest_bytes: int
