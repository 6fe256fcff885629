"""The groups of a C3D file, with the labels, units and descriptions of a measurement."""

import textwrap
from typing import Final

import numpy as np

from gateway import version_text
from gateway.descriptions.fitting_labels import fitting_labels, printable
from gateway.errors import TakeError
from gateway.export.c3d_content import C3dContent
from gateway.export.c3d_events import event_group
from gateway.export.c3d_format import (
    MAX_TEXT_BYTES,
    Groups,
    Parameter,
    Shape,
    encode_head,
    encode_text,
    standard_groups,
    text_lists,
)
from gateway.export.c3d_plates import plate_group
from gateway.export.job import ExportJob
from gateway.export.take_time import utc_text
from gateway.takes.description import TakeDetails

_TEXT_SIZES: Final = (MAX_TEXT_BYTES, 64, 32, 24, 16, 12, 8)
"""How long labels may be, in bytes; the parameters of a file have 130 kB at most."""


def encode_head_that_fits(job: ExportJob, content: C3dContent, shape: Shape) -> bytes:
    """Return everything before the frames, with texts as long as there is room for. Raises TakeError."""
    error: TakeError | None = None
    for max_bytes in _TEXT_SIZES:
        try:
            head = encode_head(shape, _groups(job, content, shape, max_bytes))
        except TakeError as too_large:
            error = too_large
            continue
        if error is not None:
            job.note(
                "a C3D file has no room for so many texts: descriptions were left out, "
                f"and labels have at most {max_bytes} bytes"
            )
        return head
    raise error or TakeError("there is no room for labels")


def _groups(job: ExportJob, content: C3dContent, shape: Shape, max_bytes: int) -> Groups:
    """Return all groups; with descriptions only if texts can have their full size."""
    groups = standard_groups(shape, [content.unit])
    labels, descriptions = _point_texts(content)
    groups["POINT"] += _texts(job, labels, descriptions, max_bytes, "marker")
    labels, descriptions, units = _channel_texts(content)
    groups["ANALOG"] += _texts(job, labels, descriptions, max_bytes, "channel")
    groups["ANALOG"] += text_lists("UNITS", [printable(unit) for unit in units])
    groups["TRIAL"] += [
        Parameter("DATE_TIME", [utc_text(content.measurement, content.start_s)]),
        Parameter("TIME_OFFSET", np.array(content.start_s, np.float32)),
        *_details(job, content.measurement.source.details),
    ]
    subject = content.measurement.source.details.subject
    if subject:
        groups["SUBJECTS"] = [
            Parameter("USED", np.array(1, np.int16)),
            Parameter("USES_PREFIXES", np.array(0, np.int16)),
            Parameter("NAMES", [printable(subject)]),
        ]
    groups["FORCE_PLATFORM"] = plate_group(content.plates)
    events = event_group(job, content.measurement, content.first_row, content.num_frames)
    if events:
        groups["EVENT"] = events
    groups["MANUFACTURER"] = [
        Parameter("SOFTWARE", ["rtc3d-gateway"]),
        Parameter("VERSION_LABEL", [version_text()]),
    ]
    return groups


def _details(job: ExportJob, details: TakeDetails) -> list[Parameter]:
    """Return the session and the note, in lines as long as a parameter can have in any script."""
    for text in (details.subject, details.session):
        if encode_text(text) != text.encode():
            job.note(f"{text!r} was cut: a C3D file has texts of at most {MAX_TEXT_BYTES} bytes")
    texts = {"SESSION": [details.session], "NOTE": textwrap.wrap(details.note, MAX_TEXT_BYTES // 4)}
    return [Parameter(name, lines) for name, lines in texts.items() if any(lines)]


def _texts(
    job: ExportJob, labels: list[str], descriptions: list[str], max_bytes: int, noun: str
) -> list[Parameter]:
    fitted = fitting_labels(labels, printable, max_bytes, noun)
    changed = sum(old != new for old, new in zip(labels, fitted, strict=True))
    if changed and max_bytes == MAX_TEXT_BYTES:
        job.note(f"{changed} labels of {noun}s were changed, because a C3D file cannot hold them")
    if max_bytes < MAX_TEXT_BYTES or not any(descriptions):
        descriptions = [""] * len(fitted)
    return [
        *text_lists("LABELS", fitted),
        *text_lists("DESCRIPTIONS", [printable(text) for text in descriptions]),
    ]


def _point_texts(content: C3dContent) -> tuple[list[str], list[str]]:
    """Return the labels and descriptions of the markers."""
    if content.markers is None:
        return [], []
    labels = list(content.markers.series.labels)
    described = content.parameters.markers.markers if content.parameters.markers else ()
    return labels, _padded([marker.description for marker in described], len(labels))


def _channel_texts(content: C3dContent) -> tuple[list[str], list[str], list[str]]:
    """Return the labels, descriptions and units of the analog channels, the added ones at the end."""
    labels: list[str] = []
    descriptions: list[str] = []
    units: list[str] = []
    if content.analog is not None:
        series = content.analog.series
        analog = series.parameters_of(0).analog
        labels += series.labels
        units += series.units
        descriptions += _padded(
            [channel.description for channel in analog.channels] if analog else [], len(labels)
        )
    for plan in content.added_plates:
        labels += plan.added_labels()
        units += plan.added_units(content.unit)
        descriptions += [plan.plate.label] * 6
    return labels, descriptions, units


def _padded(texts: list[str], count: int) -> list[str]:
    return texts[:count] + [""] * (count - len(texts))
