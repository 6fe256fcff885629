"""Labels that a file does not have as the server gave them: all formats report them here."""

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Final

from gateway.messages.descriptions.labels import given_labels
from gateway.takes.export.job import ExportJob
from gateway.takes.files.series import Series

_MAX_NAMED: Final = 10
_MAX_CHARACTERS: Final = 40


def note_labels(job: ExportJob, source: str, series: Series, written: Sequence[str], file: str = "") -> None:
    """Report the labels that a file does not have as the server gave them; the table names the first ones.

    ``series`` has constant labels, and ``written`` are the labels of its items in the file. An item without a
    label is called by its position, which is no change.
    """
    given = given_labels(series.component, series.parameters_of(0))[: len(series.labels)]
    wanted = [label if label.strip() else own for label, own in zip(given, series.labels, strict=False)]
    wanted += series.labels[len(wanted) :]
    _note_changed(job, f"{series.component.item_noun} of {source}", zip(wanted, written, strict=True), file)


def note_event_labels(job: ExportJob, source: str, labels: Sequence[str], written: Sequence[str]) -> None:
    """Report the labels of events that are written otherwise, each once."""
    _note_changed(job, f"events of {source}", dict.fromkeys(zip(labels, written, strict=True)))


def _note_changed(job: ExportJob, items: str, labels: Iterable[tuple[str, str]], file: str = "") -> None:
    changed = [(old, new) for old, new in labels if old != new]
    if changed:
        named = [f"{_short(old)!r} is {_short(new)!r}" for old, new in islice(changed, _MAX_NAMED)]
        more = ["…"] if len(changed) > _MAX_NAMED else []
        job.note(f"labels of {items} changed: {', '.join(named + more)}", file, len(changed))


def _short(label: str) -> str:
    return label if len(label) <= _MAX_CHARACTERS else label[: _MAX_CHARACTERS - 1] + "…"
