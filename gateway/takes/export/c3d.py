"""Export to C3D: markers, analog channels, force plates and events, one file per measurement.

The format is that of the C3D user guide (c3d.org): a header, parameters in groups, and frames of 32-bit
floats, all little-endian. What other programs write beyond its limits is used, too: more than 255 labels
continue in LABELS2, LABELS3, …; the number of more than 65535 frames is in TRIAL:ACTUAL_END_FIELD.

The file is written here and not by ezc3d, because ezc3d keeps the whole recording in memory (4 MB for each
second of 55 markers and 69 analog channels), does not report a full disk, and cuts files at 65535 frames.
"""

import struct
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from gateway import version_text
from gateway.errors import TakeError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.force_plates import ADDED_LABELS, CALIBRATED, calibration_of
from gateway.messages.descriptions.labels import EventText, event_text, fitting_labels, printable
from gateway.takes.export.c3d_content import MAX_LIST, C3dContent, content_of, encode_points, residual_step
from gateway.takes.export.changed_labels import note_event_labels, note_labels
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import event_seconds, named_measurements, note_missing, utc_text
from gateway.takes.export.plates import PlatePlan
from gateway.takes.export.source_frame import frame_of
from gateway.takes.files.component_rows import Array

_BLOCK_BYTES: Final = 512
_MAX_TEXT_BYTES: Final = 120
"""Texts are cut to this: 255 of them must fit into one parameter, whose size is a signed 16-bit number."""
_MAX_WORD: Final = 65535
_MAX_FRAMES: Final = 2**24
"""A float counts frames exactly up to here: 23 hours at 200 Hz."""

_MAX_PARAMETER_BLOCKS: Final = 255
_INTEL: Final = 84
_HEADER: Final = struct.Struct("<BBHHHHHfHHf")
_FOUR_CHARACTER_EVENTS: Final = 0x3039
_FOUR_CHARACTER_EVENTS_OFFSET: Final = 149 * 2

_Texts: TypeAlias = Sequence[str]
_Values: TypeAlias = _Texts | npt.NDArray[Any] | int | float
"""The values of a parameter: texts, or numbers: 16 bits if they are integers, and 32 bits if they are floats.

An array has the dimensions in the order of the C3D user guide, the first one changing fastest.
"""

_Group: TypeAlias = dict[str, _Values]
_Groups: TypeAlias = dict[str, _Group]

_KEYS: Final = ("3d", "analog", "force")
"""The components that can be in a file; the first one that a source has gives the rate of the frames."""

_BLOCK_VALUES: Final = 500_000  # values in memory at once: 2 MB


def export_c3d(job: ExportJob) -> None:
    """Write each measurement of each source to a file of its own."""
    belongs: dict[str, Array] = {}
    for measurement, path in named_measurements(job, _KEYS, "markers, analog channels or forces"):
        content = content_of(job, measurement)
        _write(job, content, path)
        source = measurement.source.name
        job.rows.written[source, "3d"] += content.num_marker_frames
        job.rows.written[source, "analog"] += content.num_samples(content.analog)
        job.rows.written[source, "force"] += content.num_samples(content.forces)
        is_near = _is_near(content, _event_seconds(content))
        job.rows.written[source, "event"] += min(int(is_near.sum()), MAX_LIST)
        belongs[source] = belongs.get(source, False) | is_near
    for source, is_in_file in belongs.items():
        if not is_in_file.all():
            job.note(f"events of {source} far from all frames left out", amount=int((~is_in_file).sum()))


def _write(job: ExportJob, content: C3dContent, path: Path) -> None:
    """Write one file. Raises TakeError if C3D cannot have its sizes."""
    samples = content.samples_per_frame
    if content.num_frames > _MAX_FRAMES:
        raise TakeError(
            f"{path.name} would have {content.num_frames} frames, but a C3D file has at most {_MAX_FRAMES}; "
            "choose a part by --from and --to"
        )
    if content.num_channels * samples > _MAX_WORD or content.num_points > _MAX_WORD:
        raise TakeError(
            f"{path.name} would have {content.num_points} markers and {content.num_channels} analog "
            f"channels with {samples} samples in each frame, more than a C3D file can have; export to .csv"
        )
    scale = 1.0
    if content.markers is not None:
        blocks = _blocks(job, content, f"reading the residuals of {path.name}")
        scale, is_exact = residual_step(content.points(start, stop) for start, stop in blocks)
        if not is_exact:
            job.note("residuals rounded to 127 steps", path.name, f"{scale:.3g} {content.unit} each")
    file = job.files.create(path)
    file.write(_head(job, content, scale))
    incomplete_samples = 0
    for start, stop in _blocks(job, content, f"writing {path.name}"):
        points = encode_points(content.points(start, stop), scale).reshape(stop - start, -1)
        channels = content.channels(start, stop)
        incomplete_samples += int(np.isnan(channels).any(axis=1).sum())
        frames = np.concatenate([points, channels.reshape(stop - start, -1)], axis=1)
        file.write(frames.astype("<f4").tobytes())
    if content.num_frames <= _MAX_WORD:  # ezc3d reads longer files to their end
        file.write(bytes(-file.tell() % _BLOCK_BYTES))
    note_missing(job, path, content.measurement, content.first_row, content.num_frames)
    if incomplete_samples:
        job.note("analog samples missing in the take are NaN", path.name, incomplete_samples)
    _note_plates_and_time(job, content, path)


def _note_plates_and_time(job: ExportJob, content: C3dContent, path: Path) -> None:
    if content.added_plates:
        job.note("forces became analog channels, six of each plate", path.name, len(content.added_plates))
    for plan in content.added_plates:
        if plan.moment_factor != 1.0:
            job.note(f"moments converted to {_force_unit(plan)}{content.unit}", path.name)
    if content.start_s * content.rate_hz >= 1:
        utc = utc_text(content.measurement, content.start_s)
        job.note(
            f"time 0 is the first frame, {utc}",
            path.name,
            f"{content.start_s:.3f} s after the beginning",
        )


def _blocks(job: ExportJob, content: C3dContent, what: str) -> Iterator[tuple[int, int]]:
    """Yield the beginnings and ends of parts of the frames; ``what`` is done with them."""
    values_per_frame = 4 * content.num_points + content.num_channels * content.samples_per_frame
    size = max(1, _BLOCK_VALUES // max(values_per_frame, 1))
    for start in range(0, content.num_frames, size):
        stop = min(start + size, content.num_frames)
        yield start, stop
        job.progress(what, stop, content.num_frames)


_TEXT_SIZES: Final = (_MAX_TEXT_BYTES, 64, 32, 24, 16, 12, 8)
"""How long labels may be, in bytes; the parameters of a file have 130 kB at most."""


def _head(job: ExportJob, content: C3dContent, scale: float) -> bytes:
    """Return everything before the frames, with texts as long as there is room for. Raises TakeError."""
    for max_bytes in _TEXT_SIZES:
        groups = _groups(job, content, scale, max_bytes)
        head = _encode_head(content, scale, groups)
        if head is not None:
            lists = (values for group in groups.values() for values in group.values())
            texts = (text for values in lists if isinstance(values, Sequence) for text in values)
            num_cut = sum(_encode_text(text) != text.encode(errors="replace") for text in texts)
            if num_cut:
                job.note(
                    "texts cut: a C3D file has short ones only",
                    amount=f"{num_cut} to {_MAX_TEXT_BYTES} bytes",
                )
            if max_bytes < _MAX_TEXT_BYTES:
                job.note(
                    "descriptions left out and labels cut: a C3D file has no room for so many texts",
                    amount=f"{max_bytes} bytes each",
                )
            _note_labels(job, content, groups)
            return head
    raise TakeError("the labels do not fit into a C3D file; export to .csv instead")


def _note_labels(job: ExportJob, content: C3dContent, groups: _Groups) -> None:
    for name, placed in (("POINT", content.markers), ("ANALOG", content.analog)):
        if placed is not None:
            parts = [values for key, values in groups[name].items() if key.startswith("LABELS")]
            written = [str(text) for part in parts if isinstance(part, Sequence) for text in part]
            source = content.measurement.source.name
            note_labels(job, source, placed.series, written[: placed.num_items])


def _groups(job: ExportJob, content: C3dContent, scale: float, max_bytes: int) -> _Groups:
    """Return all groups; with descriptions only if texts can have their full size."""
    details = content.measurement.source.details
    groups = _standard_groups(content, scale)
    labels: list[str] = []
    descriptions: list[str] = []
    if content.markers is not None:
        labels += content.markers.series.labels
        described = content.parameters.markers.markers if content.parameters.markers else ()
        descriptions += _padded([marker.description for marker in described], len(labels))
    groups["POINT"] |= _texts(labels, descriptions, max_bytes, "marker")
    labels, descriptions, units = _channel_texts(content)
    groups["ANALOG"] |= _texts(labels, descriptions, max_bytes, "channel")
    groups["ANALOG"] |= _lists("UNITS", [printable(unit) for unit in units])
    groups["TRIAL"] |= {
        "DATE_TIME": [utc_text(content.measurement, content.start_s)],
        "TIME_OFFSET": content.start_s,
    }
    if content.measurement.source.frame:
        groups["TRIAL"] |= _frame_parameters(frame_of(content.measurement.source))
    if details.session:
        groups["TRIAL"]["SESSION"] = [details.session]
    if details.note.strip():  # in lines as long as a parameter can have in any script
        groups["TRIAL"]["NOTE"] = textwrap.wrap(details.note, _MAX_TEXT_BYTES // 4)
    if details.subject:
        groups["SUBJECTS"] = {"USED": 1, "USES_PREFIXES": 0, "NAMES": [printable(details.subject)]}
    groups["FORCE_PLATFORM"] = _plate_group(content.plates)
    events = _event_group(job, content)
    if events:
        groups["EVENT"] = events
    groups["MANUFACTURER"] = {"SOFTWARE": ["rtc3d-gateway"], "VERSION_LABEL": [version_text()]}
    return groups


def _frame_parameters(frame: CoordinateFrame) -> _Group:
    """Return the frame of the source, and what brings the coordinates of the file, which are the server's,
    into it: they are scaled, rotated and moved by metres, in this order."""
    return {
        "FRAME_ID": [printable(frame.frame_id)],
        "FRAME_SCALE": frame.scale,
        "FRAME_ROTATION": np.array(frame.rotation_xyzw),
        "FRAME_TRANSLATION": np.array(frame.translation_m),
    }


def _texts(labels: list[str], descriptions: list[str], max_bytes: int, noun: str) -> _Group:
    fitted = fitting_labels(labels, printable, max_bytes, noun)
    if max_bytes < _MAX_TEXT_BYTES or not any(descriptions):
        descriptions = [""] * len(fitted)
    return _lists("LABELS", fitted) | _lists("DESCRIPTIONS", [printable(text) for text in descriptions])


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
        units += [_force_unit(plan)] * 3 + [_force_unit(plan) + content.unit] * 3
        descriptions += [plan.plate.label] * 6
    return labels, descriptions, units


def _force_unit(plan: PlatePlan) -> str:
    return (plan.plate.channels[0].unit if plan.plate.channels else "") or "N"


def _padded(texts: list[str], count: int) -> list[str]:
    return texts[:count] + [""] * (count - len(texts))


def _plate_group(plans: list[PlatePlan]) -> _Group:
    """Return the group FORCE_PLATFORM."""
    num_rows = max((len(plan.channels) for plan in plans), default=0)
    channels = [np.array(plan.channels + (-1,) * (num_rows - len(plan.channels))) + 1 for plan in plans]
    units = {plan.plate.channels[0].unit for plan in plans if plan.plate.channels} - {"", "N"}
    matrices = [calibration_of(plan.plate) if plan.type == CALIBRATED else np.zeros((6, 6)) for plan in plans]
    return {
        "USED": len(plans),
        "TYPE": np.array([plan.type for plan in plans], int),
        "ZERO": np.zeros(2, int),
        "CORNERS": _stack([plan.geometry.corners.T for plan in plans]),
        "ORIGIN": _stack([plan.geometry.origin for plan in plans]),
        "CHANNEL": _stack(channels, int),
        "CAL_MATRIX": _stack(matrices),
        **({"UNITS": [units.pop()]} if len(units) == 1 else {}),
    }


def _stack(arrays: list[Array], dtype: type = float) -> Array:
    """Return arrays along a new last dimension; an empty list if there are none."""
    return np.stack(arrays, axis=-1) if arrays else np.zeros(0, dtype)


_MINUTE_S: Final = 60.0
_SIDES: Final = {"Left", "Right"}
_MARGIN_S: Final = 1.0
"""An event within this time before the first frame or after the last one belongs to the measurement."""

_RESOLUTION_S: Final = 1e-6  # of time stamps


def _event_seconds(content: C3dContent) -> Array:
    """Return when the events of the source were, in s from the first frame."""
    return event_seconds(content.measurement) - content.first_row / content.measurement.grid.rate_hz


def _is_near(content: C3dContent, seconds: Array) -> Array:
    """Return for each time whether it belongs to the frames."""
    duration_s = content.num_frames / content.measurement.grid.rate_hz
    return (seconds > -_MARGIN_S) & (seconds < duration_s + _MARGIN_S)


def _event_group(job: ExportJob, content: C3dContent) -> _Group:
    """Return the group EVENT with the events of the frames; {} if there are none."""
    events = content.measurement.source.events
    seconds = _event_seconds(content)
    (chosen,) = np.nonzero(_is_near(content, seconds))
    chosen = chosen[np.argsort(seconds[chosen], kind="stable")]
    if len(chosen) > MAX_LIST:
        left_out = len(chosen) - MAX_LIST
        job.note("events left out: a C3D file has at most 255", amount=f"{left_out} of {len(chosen)}")
        chosen = chosen[:MAX_LIST]
    if events is None or not len(chosen):
        return {}
    num_early = int((seconds[chosen] < -_RESOLUTION_S).sum())
    if num_early:
        job.note("events before the first frame have its time", amount=num_early)
    subject = content.measurement.source.details.subject
    texts = [event_text(events.parameters_of(row), events.items[row]) for row in chosen.tolist()]
    labels = [printable(text.label) for text in texts]
    written = [_encode_text(label).decode() for label in labels]
    note_event_labels(job, content.measurement.source.name, [text.label for text in texts], written)
    return {
        "USED": len(chosen),
        "CONTEXTS": [printable(_context_of(text)) for text in texts],
        "LABELS": labels,
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


def _lists(name: str, values: _Texts | npt.NDArray[Any]) -> _Group:
    """Return a list of texts or numbers as NAME, and NAME2, NAME3, … if they are more than 255."""
    parts = enumerate(range(0, max(len(values), 1), MAX_LIST), start=1)
    return {name if part == 1 else f"{name}{part}": values[at : at + MAX_LIST] for part, at in parts}


def _standard_groups(content: C3dContent, scale: float) -> _Groups:
    """Return POINT, ANALOG and TRIAL with the sizes and rates; labels and the like are still missing."""
    return {
        "POINT": {
            "USED": content.num_points,
            "SCALE": -scale,
            "RATE": content.rate_hz,
            "DATA_START": 0,
            "FRAMES": min(content.num_frames, _MAX_WORD),
            "UNITS": [content.unit],
            **({"LONG_FRAMES": float(content.num_frames)} if content.num_frames > _MAX_WORD else {}),
        },
        "ANALOG": {
            "USED": content.num_channels,
            "GEN_SCALE": 1.0,
            "RATE": content.rate_hz * content.samples_per_frame if content.num_channels else 0.0,
            "FORMAT": ["SIGNED"],
            "BITS": 16,
            **_lists("SCALE", np.ones(content.num_channels)),
            **_lists("OFFSET", np.zeros(content.num_channels, int)),
        },
        "TRIAL": {
            "ACTUAL_START_FIELD": np.array([1, 0]),
            "ACTUAL_END_FIELD": np.array([content.num_frames & _MAX_WORD, content.num_frames >> 16]),
            "CAMERA_RATE": content.rate_hz,
        },
    }


def _encode_head(content: C3dContent, scale: float, groups: _Groups) -> bytes | None:
    """Return everything before the frames, with POINT:DATA_START; None if the parameters are too large."""
    num_blocks = -(-len(_encode_groups(groups)) // _BLOCK_BYTES)
    if num_blocks > _MAX_PARAMETER_BLOCKS:
        return None
    data_block = groups["POINT"]["DATA_START"] = 2 + num_blocks
    samples_per_frame = content.samples_per_frame if content.num_channels else 0
    header = bytearray(_BLOCK_BYTES)
    _HEADER.pack_into(
        header,
        0,
        2,  # the block of the parameters
        0x50,
        content.num_points,
        content.num_channels * samples_per_frame,
        1,  # the number of the first frame
        min(content.num_frames, _MAX_WORD),
        10,  # the largest gap that may be interpolated, in frames
        -scale,  # negative: the points are floats
        data_block,
        samples_per_frame,
        content.rate_hz,
    )
    struct.pack_into("<H", header, _FOUR_CHARACTER_EVENTS_OFFSET, _FOUR_CHARACTER_EVENTS)
    return bytes(header) + _encode_groups(groups).ljust(num_blocks * _BLOCK_BYTES, b"\0")


def _encode_groups(groups: _Groups) -> bytes:
    records = []
    for number, (name, parameters) in enumerate(groups.items(), start=1):
        records.append(_record(name, -number, b""))
        records += [_record(each, number, _encode_values(values)) for each, values in parameters.items()]
    body = b"".join(records) + b"\0\0"
    num_blocks = -(-(4 + len(body)) // _BLOCK_BYTES)
    return struct.pack("<BBBB", 1, 0x50, min(num_blocks, 255), _INTEL) + body


def _record(name: str, number: int, content: bytes) -> bytes:
    """Return a group or a parameter, with an empty description; the offset counts from itself."""
    head = struct.pack("<bb", len(name), number) + name.encode("ascii")
    return head + struct.pack("<H", 3 + len(content)) + content + b"\0"


def _encode_values(values: _Values) -> bytes:
    if isinstance(values, Sequence):
        encoded = [_encode_text(text) for text in values]
        width = max(map(len, encoded), default=0)
        data = b"".join(text.ljust(width) for text in encoded)
        return struct.pack("<bBBB", -1, 2, width, len(encoded)) + data
    numbers = np.asarray(values)
    kind, dtype = (4, "<f4") if numbers.dtype.kind == "f" else (2, "<i2")
    sizes = struct.pack("<bB", kind, numbers.ndim) + bytes(numbers.shape)
    return sizes + numbers.astype(dtype).tobytes(order="F")


def _encode_text(text: str) -> bytes:
    """Return a text as UTF-8 of at most _MAX_TEXT_BYTES, cut between two characters."""
    return text.encode(errors="replace")[:_MAX_TEXT_BYTES].decode(errors="ignore").encode()
