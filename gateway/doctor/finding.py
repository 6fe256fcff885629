"""What the doctor says of one thing that it looked at."""

from enum import StrEnum
from typing import NamedTuple


class Result(StrEnum):
    """How it is."""

    GREEN = "green"
    RED = "red"
    NOT_TESTED = "not tested"


class Finding(NamedTuple):
    """One result: ``found`` says what is, of a red one ``remedy`` what to do; both are sentences.

    ``subject`` is a source's name, or what else was looked at; ``check`` is the layer.
    """

    subject: str
    check: str
    result: Result
    found: str
    remedy: str = ""


class Patient(NamedTuple):
    """Makes the findings of one subject."""

    subject: str

    def good(self, check: str, found: str) -> Finding:
        """Return that it is as it should be."""
        return Finding(self.subject, check, Result.GREEN, found)

    def bad(self, check: str, found: str, remedy: str) -> Finding:
        """Return that it is not."""
        return Finding(self.subject, check, Result.RED, found, remedy)

    def untested(self, check: str, because: str) -> Finding:
        """Return that it could not be seen, ``because`` of something."""
        return Finding(self.subject, check, Result.NOT_TESTED, because)
