"""The parameters of one source in a take: how they changed, and what each version says."""

from typing import Final, NamedTuple

from gateway.messages.descriptions.labels import event_labels
from gateway.rtc3d.parameters import Parameters, changed_sections, describe_renames, sections_of
from gateway.takes.files.parameters_history import ParametersEntry

MAX_LISTED_CHANGES: Final = 100
"""How many changes of the parameters are listed; all are counted."""

_MAX_VERSIONS: Final = 32
"""How many versions of the parameters are kept to label what follows."""


class ParametersChange(NamedTuple):
    """The server's parameters at the beginning or after a change; ``text`` says what changed."""

    utime: int
    version: int
    text: str


class ParametersStatistics:
    """The changes of the server's parameters, with bounded memory."""

    def __init__(self) -> None:
        self.changes: list[ParametersChange] = []
        """The first changes, at most MAX_LISTED_CHANGES."""
        self.num_changes = 0
        self.event_labels: dict[int, str] = {}
        """The labels of events by id (§6.6)."""
        self.by_version: dict[int, Parameters] = {}
        """The newest versions, at most _MAX_VERSIONS."""

    def add(self, entry: ParametersEntry, before: Parameters | None) -> dict[int, Parameters]:
        """Take parameters that follow ``before``, which is None at the beginning.

        Return the parameters that ``by_version`` had so far and now lacks, by version: what has come with
        this version can be labelled by them only now. Versions start again with the gateway.
        """
        utime, version, parameters, _ = entry
        self.num_changes += 1
        if len(self.changes) < MAX_LISTED_CHANGES:
            self.changes.append(ParametersChange(utime, version, _change_text(before, parameters)))
        self.event_labels |= event_labels(parameters)
        removed = {version: self.by_version[version]} if version in self.by_version else {}
        self.by_version[version] = parameters
        if len(self.by_version) > _MAX_VERSIONS:
            oldest = next(iter(self.by_version))
            removed[oldest] = self.by_version.pop(oldest)
        return removed


def _change_text(before: Parameters | None, after: Parameters) -> str:
    if before is None:
        return "first: " + (", ".join(sorted(sections_of(after))) or "none")
    if after == Parameters():
        return "the server gives no parameters now"
    texts = [describe_renames(before, after), ", ".join(changed_sections(before, after))]
    return "; ".join(text for text in texts if text) or "the same"
