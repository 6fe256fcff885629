"""The labels in text files of OpenSim."""

import re
from typing import Final

from gateway.messages.descriptions.labels import fitting_labels
from gateway.takes.export.changed_labels import note_labels
from gateway.takes.export.job import ExportJob
from gateway.takes.files.series import Series

NOT_IN_LABELS: Final = re.compile(r"[^\w.:-]+")
"""OpenSim forbids ``* + space tab newline / \\`` in names."""
_MAX_LABEL_BYTES: Final = 100
_TIME: Final = "time"
"""The label of the first column, which no other may have."""


def opensim_labels(job: ExportJob, file: str, source: str, series: Series) -> tuple[str, ...]:
    """Return labels as OpenSim can read them, each different, and report those that were changed."""

    noun = series.component.item_noun.removesuffix("s")

    def fit(label: str) -> str:
        text = NOT_IN_LABELS.sub("_", label.strip())
        return f"{noun}_{text}" if text.casefold() == _TIME else text

    fitted = fitting_labels(series.labels, fit, _MAX_LABEL_BYTES, noun)
    note_labels(job, source, series, fitted, file)
    return fitted
