"""The labels in text files of OpenSim."""

import re
from collections.abc import Sequence
from typing import Final

from gateway.descriptions.labels import fitting_labels
from gateway.takes.export.job import ExportJob

NOT_IN_LABELS: Final = re.compile(r"[^\w.:-]+")
"""OpenSim forbids ``* + space tab newline / \\`` in names."""
_MAX_LABEL_BYTES: Final = 100
_TIME: Final = "time"
"""The label of the first column, which no other may have."""


def opensim_labels(job: ExportJob, file: str, labels: Sequence[str], noun: str) -> tuple[str, ...]:
    """Return labels as OpenSim can read them, each different, and report those that were changed."""

    def fit(label: str) -> str:
        text = NOT_IN_LABELS.sub("_", label.strip())
        return f"{noun}_{text}" if text.casefold() == _TIME else text

    fitted = fitting_labels(labels, fit, _MAX_LABEL_BYTES, noun)
    changed = sum(old != new for old, new in zip(labels, fitted, strict=True))
    if changed:
        job.note(f"labels of {noun}s: spaces and special characters replaced", file, changed)
    return fitted
