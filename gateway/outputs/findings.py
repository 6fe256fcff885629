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


class Check(NamedTuple):
    """One check of a subject: a source, an output or this computer. Creates its findings.

    ``stream`` are the components of the stream that is checked, if its source has several.
    """

    subject: str
    name: str
    stream: str = ""

    def passing(self, found: str) -> Finding:
        """Return a passing finding."""
        return Finding(self.subject, self.name, Result.PASSING, found, "", self.stream)

    def note(self, found: str, remedy: str = "") -> Finding:
        """Return a note, and what to do if it is not as intended."""
        return Finding(self.subject, self.name, Result.NOTE, found, remedy, self.stream)

    def warning(self, found: str, remedy: str) -> Finding:
        """Return a warning and what to do about it."""
        return Finding(self.subject, self.name, Result.WARNING, found, remedy, self.stream)

    def failing(self, found: str, remedy: str) -> Finding:
        """Return a failing finding and what to do about it."""
        return Finding(self.subject, self.name, Result.FAILING, found, remedy, self.stream)

    def problem(self, text: str, default_remedy: str = "") -> Finding:
        """Return a failing finding for the text of an error: what is wrong, "; ", and what to do about it.

        Without what to do, it is ``default_remedy``.
        """
        found, _, remedy = text.partition("; ")
        return self.failing(found, as_sentence(remedy) if remedy else default_remedy)

    def not_tested(self, reason: str) -> Finding:
        """Return a finding for a check that could not be made."""
        return Finding(self.subject, self.name, Result.NOT_TESTED, reason, "", self.stream)


def failing_first(failing: Finding, later: Iterable[str]) -> list[Finding]:
    """Return a failing finding, and that the ``later`` checks of its subject are not made because of it."""
    reason = f"it needs {failing.check}, which failed"
    return [failing, *(Check(failing.subject, name).not_tested(reason) for name in later)]


def as_sentence(text: str) -> str:
    """Return the words of an error, such as what to do about it, with a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:]}."


class MessageLoad(NamedTuple):
    """The rate of one component's messages, and the size of the largest."""

    rate_hz: float
    largest_bytes: int
