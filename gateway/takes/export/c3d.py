"""Export to C3D: markers, analog channels, force plates and events, one file per measurement."""

import textwrap
from pathlib import Path
from typing import Final

import numpy as np

from gateway import version_text
from gateway.descriptions.force_plates import ADDED_LABELS
from gateway.descriptions.labels import MAX_EVENT_AGE_US, EventText, event_text, fitting_labels, printable
from gateway.errors import TakeError
from gateway.takes.export.c3d_content import C3dContent, content_of, encode_points, plate_group, residual_step
from gateway.takes.export.c3d_format import (
    BLOCK_BYTES,
    MAX_FRAMES,
    MAX_LIST,
    MAX_TEXT_BYTES,
    MAX_WORD,
    Group,
    Groups,
    Shape,
    encode_head,
    encode_text,
    lists,
    rate_in_float32,
    standard_groups,
)
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import Measurement, named_measurements, note_missing, utc_text

_KEYS: Final = ("3d", "analog", "force")
"""The components that can be in a file; the first one that a source has gives the rate of the frames."""

_BLOCK_VALUES: Final = 2_000_000  # values in memory at once: 8 MB


def export_c3d(job: ExportJob) -> None:
    """Write each measurement of each source to a file of its own."""
    for measurement, path in named_measurements(job, _KEYS, "markers, analog channels or forces"):
        _write(job, content_of(job, measurement), path)
        if measurement.source.tools is not None:
            job.note("tools (6D) were left out: a C3D file has points, analog channels and events")


def _write(job: ExportJob, content: C3dContent, path: Path) -> None:
    """Write one file."""
    shape = _shape(content, path)
    size = max(
        1, _BLOCK_VALUES // max(4 * shape.num_points + shape.num_channels * shape.samples_per_frame, 1)
    )
    blocks = [(start, min(start + size, shape.num_frames)) for start in range(0, shape.num_frames, size)]
    if content.markers is not None:
        job.progress(f"reading the residuals of {path.name}", 0, 0)
        step = residual_step(content.points(start, stop) for start, stop in blocks)
        shape = shape._replace(scale=step)
    file = job.files.create(path)
    file.write(_head(job, content, shape))
    incomplete_samples = 0
    for start, stop in blocks:
        points = encode_points(content.points(start, stop), shape.scale).reshape(stop - start, -1)
        channels = content.channels(start, stop)
        incomplete_samples += int(np.isnan(channels).any(axis=1).sum())
        frames = np.concatenate([points, channels.reshape(stop - start, -1)], axis=1)
        file.write(frames.astype("<f4").tobytes())
        job.progress(f"writing {path.name}", stop, content.num_frames)
    if content.num_frames <= MAX_WORD:  # ezc3d reads longer files to their end
        file.write(bytes(-file.tell() % BLOCK_BYTES))
    note_missing(job, path, content.measurement, content.first_row, content.num_frames)
    if content.start_s * shape.rate_hz >= 1:
        begin = f"{content.start_s:.3f} s after the take's beginning"
        utc = utc_text(content.measurement, content.start_s)
        job.note(f"{path.name}: time 0 is its first frame, {begin} ({utc})")
    if incomplete_samples:
        job.note(f"{path.name}: {incomplete_samples} analog samples are missing in the take; they are NaN")


def _shape(content: C3dContent, path: Path) -> Shape:
    """Return the sizes of a file. Raises TakeError if C3D cannot have them."""
    samples = content.samples_per_frame
    if content.num_frames > MAX_FRAMES:
        raise TakeError(
            f"{path.name} would have {content.num_frames} frames, but a C3D file has at most {MAX_FRAMES}; "
            "choose a part by --from and --to"
        )
    if content.num_channels * samples > MAX_WORD or content.num_points > MAX_WORD:
        raise TakeError(
            f"{path.name} would have {content.num_points} markers and {content.num_channels} analog "
            f"channels with {samples} samples in each frame, more than a C3D file can have; export to .csv"
        )
    rate_hz = rate_in_float32(content.measurement.grid.rate_hz, samples)
    return Shape(content.num_points, content.num_channels, samples, content.num_frames, rate_hz, 1.0)


_TEXT_SIZES: Final = (MAX_TEXT_BYTES, 64, 32, 24, 16, 12, 8)
"""How long labels may be, in bytes; the parameters of a file have 130 kB at most."""


def _head(job: ExportJob, content: C3dContent, shape: Shape) -> bytes:
    """Return everything before the frames, with texts as long as there is room for. Raises TakeError."""
    for max_bytes in _TEXT_SIZES:
        head = encode_head(shape, _groups(job, content, shape, max_bytes))
        if head is not None:
            if max_bytes < MAX_TEXT_BYTES:
                job.note(
                    "a C3D file has no room for so many texts: descriptions were left out, "
                    f"and labels have at most {max_bytes} bytes"
                )
            return head
    raise TakeError("the labels do not fit into a C3D file; export to .csv instead")


def _groups(job: ExportJob, content: C3dContent, shape: Shape, max_bytes: int) -> Groups:
    """Return all groups; with descriptions only if texts can have their full size."""
    details = content.measurement.source.details
    groups = standard_groups(shape, content.unit)
    labels: list[str] = []
    descriptions: list[str] = []
    if content.markers is not None:
        labels += content.markers.series.labels
        described = content.parameters.markers.markers if content.parameters.markers else ()
        descriptions += _padded([marker.description for marker in described], len(labels))
    groups["POINT"] |= _texts(job, labels, descriptions, max_bytes, "marker")
    labels, descriptions, units = _channel_texts(content)
    groups["ANALOG"] |= _texts(job, labels, descriptions, max_bytes, "channel")
    groups["ANALOG"] |= lists("UNITS", [printable(unit) for unit in units])
    groups["TRIAL"] |= {
        "DATE_TIME": [utc_text(content.measurement, content.start_s)],
        "TIME_OFFSET": content.start_s,
    }
    for text in (details.subject, details.session):
        if encode_text(text) != text.encode():
            job.note(f"{text!r} was cut: a C3D file has texts of at most {MAX_TEXT_BYTES} bytes")
    if details.session:
        groups["TRIAL"]["SESSION"] = [details.session]
    if details.note.strip():  # in lines as long as a parameter can have in any script
        groups["TRIAL"]["NOTE"] = textwrap.wrap(details.note, MAX_TEXT_BYTES // 4)
    if details.subject:
        groups["SUBJECTS"] = {"USED": 1, "USES_PREFIXES": 0, "NAMES": [printable(details.subject)]}
    groups["FORCE_PLATFORM"] = plate_group(content.plates)
    events = _event_group(job, content.measurement, content.first_row, content.num_frames)
    if events:
        groups["EVENT"] = events
    groups["MANUFACTURER"] = {"SOFTWARE": ["rtc3d-gateway"], "VERSION_LABEL": [version_text()]}
    return groups


def _texts(job: ExportJob, labels: list[str], descriptions: list[str], max_bytes: int, noun: str) -> Group:
    fitted = fitting_labels(labels, printable, max_bytes, noun)
    changed = sum(old != new for old, new in zip(labels, fitted, strict=True))
    if changed and max_bytes == MAX_TEXT_BYTES:
        job.note(f"{changed} labels of {noun}s were changed, because a C3D file cannot hold them")
    if max_bytes < MAX_TEXT_BYTES or not any(descriptions):
        descriptions = [""] * len(fitted)
    return lists("LABELS", fitted) | lists("DESCRIPTIONS", [printable(text) for text in descriptions])


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
        labels += [f"{label}{plan.position + 1}" for label in ADDED_LABELS]
        force = (plan.plate.channels[0].unit if plan.plate.channels else "") or "N"
        units += [force] * 3 + [force + content.unit] * 3
        descriptions += [plan.plate.label] * 6
    return labels, descriptions, units


def _padded(texts: list[str], count: int) -> list[str]:
    return texts[:count] + [""] * (count - len(texts))


_MINUTE_S: Final = 60.0
_SIDES: Final = {"Left", "Right"}
_MARGIN_S: Final = 1.0
"""An event within this time before the first frame or after the last one belongs to the measurement."""


def _event_group(job: ExportJob, measurement: Measurement, first_row: int, num_rows: int) -> Group:
    """Return the group EVENT with the events of these rows; {} if there are none.

    The time of an event is its own, or that of its frame if it is far from that.
    """
    events = measurement.source.events
    if events is None:
        return {}
    rate_hz = measurement.grid.rate_hz
    own_us = events.items["timestamp"]
    is_near = abs(own_us.astype(np.float64) - events.timestamp_us) <= MAX_EVENT_AGE_US
    times_us = np.where(is_near, own_us, events.timestamp_us)
    seconds = measurement.seconds_of(times_us, events.capture_utime) - first_row / rate_hz
    (chosen,) = np.nonzero((seconds > -_MARGIN_S) & (seconds < num_rows / rate_hz + _MARGIN_S))
    chosen = chosen[np.argsort(seconds[chosen], kind="stable")]
    if len(chosen) > MAX_LIST:
        left_out = len(chosen) - MAX_LIST
        job.note(f"{left_out} of {len(chosen)} events were left out: a C3D file has at most 255")
        chosen = chosen[:MAX_LIST]
    if not len(chosen):
        return {}
    subject = measurement.source.details.subject
    texts = [event_text(events.parameters_of(row), events.items[row]) for row in chosen.tolist()]
    return {
        "USED": len(chosen),
        "CONTEXTS": [printable(_context_of(text)) for text in texts],
        "LABELS": [printable(text.label) for text in texts],
        "DESCRIPTIONS": [printable(text.description) for text in texts],
        "SUBJECTS": [printable(_value_of(text, "subject") or subject) for text in texts],
        "TIMES": np.stack(np.divmod(np.maximum(seconds[chosen], 0.0), _MINUTE_S)),
        "ICON_IDS": np.zeros(len(chosen), int),
        "GENERIC_FLAGS": np.zeros(len(chosen), int),
    }


def _context_of(text: EventText) -> str:
    """Return Left, Right or General, by a parameter of the event, or else by a word of its label.

    A parameter called Context, as the simulator has it for events of C3D files, can say something else.
    """
    named = _value_of(text, "context")
    if named:
        return named
    for words in ([value.strip() for _, value in text.values], text.label.split()):
        sides = _SIDES & {word.capitalize() for word in words}
        if len(sides) == 1:
            return sides.pop()
    return "General"


def _value_of(text: EventText, name: str) -> str:
    """Return the value of a parameter of the event; "" if it has none of this name."""
    return next((value for each, value in text.values if each.strip().casefold() == name), "")
