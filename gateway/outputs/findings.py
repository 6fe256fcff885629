"""Results of checks; the doctor reports them."""

from collections.abc import Iterable
from enum import StrEnum
from typing import Final, NamedTuple


class Result(StrEnum):
    """The result of a check. The values appear in the doctor's JSON.

    A warning is about something that may cost data or make it less useful; a note needs no action. Neither
    is a failure.
    """

    PASSING = "green"
    NOTE = "note"
    WARNING = "warning"
    FAILING = "red"
    NOT_TESTED = "not tested"


NO_CONFIGURATION: Final = "it needs the configuration, which failed"
"""The reason why a check was not made, if the configuration is not valid."""


class Finding(NamedTuple):
    """The result of one check.

    ``subject`` is what was checked: the name of a source, or for example "zenoh". ``check`` names the check.
    ``found`` says what was found, or why the check was not made. ``remedy`` says what to do if it fails.
    ``stream`` are the components of the stream that was checked, if its source has several.
    """

    subject: str
    check: str
    result: Result
    found: str
    remedy: str = ""
    stream: str = ""

    @property
    def is_of_disabled_output(self) -> bool:
        """Whether the check was not made because the configuration does not enable the output."""
        return self.result is Result.NOT_TESTED and self.found == f"{self.subject}.enabled is false"

    @property
    def lacks_configuration(self) -> bool:
        """Whether the check was not made because the configuration is not valid."""
        return self.result is Result.NOT_TESTED and self.found == NO_CONFIGURATION


class Subject(NamedTuple):
    """Something that is checked: a source, one of its streams, an output or this computer.

    Creates its findings.
    """

    name: str
    stream: str = ""

    def passing(self, check: str, found: str) -> Finding:
        """Return a passing finding."""
        return Finding(self.name, check, Result.PASSING, found, "", self.stream)

    def note(self, check: str, found: str, remedy: str = "") -> Finding:
        """Return a note, and what to do if it is not as intended."""
        return Finding(self.name, check, Result.NOTE, found, remedy, self.stream)

    def warning(self, check: str, found: str, remedy: str) -> Finding:
        """Return a warning and what to do about it."""
        return Finding(self.name, check, Result.WARNING, found, remedy, self.stream)

    def failing(self, check: str, found: str, remedy: str) -> Finding:
        """Return a failing finding and what to do about it."""
        return Finding(self.name, check, Result.FAILING, found, remedy, self.stream)

    def problem(self, check: str, text: str, default_remedy: str = "") -> Finding:
        """Return a failing finding for the text of an error: what is wrong, "; ", and what to do about it.

        Without what to do, it is ``default_remedy``.
        """
        found, _, remedy = text.partition("; ")
        return self.failing(check, found, as_sentence(remedy) if remedy else default_remedy)

    def failing_first(self, failing: Finding, later: Iterable[str]) -> list[Finding]:
        """Return a failing finding, and that the ``later`` checks are not made because of it."""
        reason = f"it needs {failing.check}, which failed"
        return [failing, *(self.not_tested(check, reason) for check in later)]

    def not_tested(self, check: str, reason: str) -> Finding:
        """Return a finding for a check that could not be made."""
        return Finding(self.name, check, Result.NOT_TESTED, reason, "", self.stream)

    def disabled(self, check: str) -> Finding:
        """Return a finding for a check of an output that the configuration does not enable."""
        return self.not_tested(check, f"{self.name}.enabled is false")


def counted(number: int, noun: str) -> str:
    """Return a number of things, such as "1 router" or "2 routers"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def as_sentence(text: str) -> str:
    """Return the words of an error, such as what to do about it, with a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:]}."


class MessageLoad(NamedTuple):
    """The rate of one component's messages, and the size of the largest."""

    rate_hz: float
    largest_bytes: int
