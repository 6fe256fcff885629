"""What a C3D file has, read with ezc3d: points, analog channels, force plates and events."""

import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.errors import TakeError
from gateway.messages.descriptions.labels import UNUSED, common
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, MISSING_MARKER, ComponentType, Items
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
)
from gateway.session.c3d_files.receiving import PARAMETERS_END_BYTES, problem_of_sizes
from gateway.session.server.scene import NO_EVENTS
from gateway.simulator.bodies import force_channels
from gateway.simulator.c3d_header import Correction, corrections, stated_frames

_log = logging.getLogger(__name__)
_ITEM_TEXTS: Final = ("LABELS", "DESCRIPTIONS")
_WHOLE_UNITS: Final = {"mill": "mm", "cent": "cm", "mete": "m"}
"""Units that programs cut to four characters (field note 28)."""


class C3dRecording(NamedTuple):
    """The content of a C3D file.

    ``items`` and ``rates_hz`` have the components that the file has. ``num_frames`` counts frames at
    ``measurement_rate_hz``. ``events`` have their times in µs since the first frame, in order.
    """

    parameters: Parameters
    items: dict[ComponentType, Items]
    rates_hz: dict[ComponentType, float]
    measurement_rate_hz: float
    num_frames: int
    events: Items


def load_recording(path: Path) -> C3dRecording:
    """Read a whole file; log what it lacks. Raises TakeError if it cannot be played, and MemoryError."""
    with path.open("rb") as file:
        head = file.read(PARAMETERS_END_BYTES)
        # What is impossible is refused, not corrected.
        is_possible = not problem_of_sizes(head, os.fstat(file.fileno()).st_size)
        found = corrections(head) if is_possible else []
        for each in found:
            if not each.is_rounding:
                given, stated = f"{each.value:g}", f"{each.stated:g}"
                text = "%s: %s is %s, but the header says %s; the header is taken"
                _log.warning(text, path, each.parameter, given, stated)
        content = _read(path, _corrected_copy(file, found) if found else path)
    try:
        recording = _convert(path, content, head)
        _report_missing_frames(path, recording, stated_frames(head) if is_possible else None)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise TakeError(
            f"{path} lacks required C3D data ({type(error).__name__}: {error}); "
            "open it in the software that recorded it and export it again"
        ) from error
    if not recording.rates_hz:
        raise TakeError(f"{path} has neither markers nor analog channels; choose another file")
    if min(*recording.rates_hz.values(), recording.measurement_rate_hz) <= 0:
        raise TakeError(f"{path} has no rate for its data (POINT:RATE, ANALOG:RATE); export it again")
    return recording


def _report_missing_frames(path: Path, recording: C3dRecording, stated: int | None) -> None:
    """Log that the file has fewer frames than its header ``stated``: somebody has not copied all of it."""
    points = recording.items.get(ComponentType.MARKERS)
    if stated is not None and points is not None and len(points) < stated:
        _log.warning("%s is cut off: it has %d of its %d frames", path, len(points), stated)


def _corrected_copy(file: BinaryIO, found: Sequence[Correction]) -> Path:
    """Return a copy of a file with the corrections, in memory until the process ends."""
    descriptor = os.memfd_create("c3d")
    with os.fdopen(descriptor, "wb", closefd=False) as copy:
        file.seek(0)
        shutil.copyfileobj(file, copy)
    for each in found:
        os.pwrite(descriptor, each.content, each.position)
    return Path(f"/proc/self/fd/{descriptor}")


def _read(path: Path, copy: Path) -> Any:
    """Return what ezc3d reads from ``copy``, including force plates if it supports their type.

    ``path`` is the user's file, for messages.
    """
    import ezc3d  # noqa: PLC0415 - an optional extra

    try:
        return ezc3d.c3d(str(copy), extract_forceplat_data=True)
    except Exception as error:  # noqa: BLE001 - the C++ library does not document its errors
        _raise_memory_error(error)
    try:
        content = ezc3d.c3d(str(copy))
    except Exception as error:
        _raise_memory_error(error)
        raise TakeError(f"{path} cannot be read as a C3D file ({error}); choose another file") from error
    _log.warning("%s: ezc3d does not support this type of force plates; playing the file without them", path)
    return content


def _raise_memory_error(error: Exception) -> None:
    """Raise MemoryError if ``error`` is what ezc3d raises in place of it."""
    if isinstance(error, MemoryError) or "bad_alloc" in str(error):
        raise MemoryError from error


def _convert(path: Path, content: Any, head: bytes) -> C3dRecording:
    parameters, data = content["parameters"], content["data"]
    point, analog = parameters["POINT"], parameters["ANALOG"]
    point_rate_hz, analog_rate_hz = _number(point, "RATE"), _number(analog, "RATE")
    all_rates_hz = {
        ComponentType.MARKERS: point_rate_hz,
        ComponentType.ANALOG: analog_rate_hz,
        ComponentType.FORCE: analog_rate_hz,
    }
    all_items = {
        ComponentType.MARKERS: _markers(data["points"], data["meta_points"]["residuals"]),
        ComponentType.ANALOG: data["analogs"][0].T.astype(ITEM_DTYPES[ComponentType.ANALOG]),
        ComponentType.FORCE: _forces(data.get("platform", [])),
    }
    items: dict[ComponentType, Items] = {c: array for c, array in all_items.items() if array.size}
    rates_hz = {component: all_rates_hz[component] for component in items}
    slowest = min(items, key=lambda component: rates_hz[component], default=ComponentType.MARKERS)
    rate_hz, num_frames = all_rates_hz[slowest], len(all_items[slowest])
    length_s = num_frames / rate_hz if rate_hz > 0 else 0.0
    frame_rate_hz = point_rate_hz if point_rate_hz > 0 else rate_hz or 1.0
    definitions, events = _read_events(path, content, head, frame_rate_hz, length_s)
    described = replace(_describe(path, parameters, data, point_rate_hz, analog_rate_hz), events=definitions)
    return C3dRecording(described, items, rates_hz, rate_hz, num_frames, events)


def _markers(points: npt.NDArray[np.float64], residuals: npt.NDArray[np.float64]) -> Items:
    """Return the 3D items, shape (frames, markers), from ezc3d's points, shape (4, markers, frames)."""
    values = np.empty((points.shape[2], points.shape[1], 4), ">f4")
    values[..., :3] = points[:3].T
    values[..., 3] = residuals[0].T
    missing = np.isnan(values[..., :3]).any(axis=2) | (values[..., 3] == -1)
    values[missing] = MISSING_MARKER
    return values.view(ITEM_DTYPES[ComponentType.MARKERS])[..., 0]


def _forces(plates: list[Any]) -> Items:
    """Return the Force items, shape (samples, plates); ezc3d's force and moment have shape (3, samples)."""
    dtype = ITEM_DTYPES[ComponentType.FORCE]
    if not plates:
        return np.empty((0, 0), dtype)
    values = np.array([np.concatenate([plate["force"], plate["moment"]]) for plate in plates])
    ordered = np.ascontiguousarray(values.transpose(2, 0, 1), dtype=">f4")
    return ordered.view(dtype)[..., 0]


def _describe(
    path: Path, parameters: Any, data: Any, point_rate_hz: float, analog_rate_hz: float
) -> Parameters:
    """Return the parameters of markers, channels and plates; C3D has no label or excitation of plates."""
    point, analog = parameters["POINT"], parameters["ANALOG"]
    num_points, num_channels = data["points"].shape[1], data["analogs"].shape[1]
    [unit] = _texts_of(point, "UNITS", 1)
    if not unit and num_points:
        _log.warning("%s does not say the unit of its points (POINT:UNITS); mm is assumed", path)
    unit = _WHOLE_UNITS.get(unit, unit or "mm")
    for group, name, count in ((point, "POINT", num_points), (analog, "ANALOG", num_channels)):
        num_labels = sum(map(bool, _texts_of(group, "LABELS", count)))
        if 0 < num_labels < count:
            _log.warning(
                "%s has %d labels for its %d items (%s:LABELS); the others are numbered",
                *(path, num_labels, count, name),
            )
    point_texts = zip(*(_texts_of(point, name, num_points) for name in _ITEM_TEXTS), strict=True)
    markers = tuple(
        Marker(str(number), label or f"Marker {number}", description)
        for number, (label, description) in enumerate(point_texts, start=1)
    )
    analog_units = _texts_of(analog, "UNITS", num_channels)
    if "" in analog_units:
        text = "%s does not say the unit of %d of its %d analog channels (ANALOG:UNITS)"
        _log.warning(text, path, analog_units.count(""), num_channels)
    analog_texts = zip(
        *(_texts_of(analog, name, num_channels) for name in _ITEM_TEXTS), analog_units, strict=True
    )
    channels = tuple(
        AnalogChannel(str(number), label or f"Analog {number}", description, channel_unit, analog_rate_hz)
        for number, (label, description, channel_unit) in enumerate(analog_texts, start=1)
    )
    plates = []
    for index, plate in enumerate(data.get("platform", [])):
        force_unit, moment_unit = plate["unit_force"], plate["unit_moment"]
        if plate["unit_position"] != unit:  # ezc3d says metres if the file says nothing
            moment_unit = f"{force_unit}{unit}"
        group = parameters["FORCE_PLATFORM"]
        ids = np.reshape(group["CHANNEL"]["value"], (-1, len(group["TYPE"]["value"])))
        # For plate types without a calibration matrix, ezc3d returns zeros.
        rows = plate["cal_matrix"] if plate["cal_matrix"].any() else ()
        plates.append(
            Plate(
                id=str(index + 1),
                label=f"Force plate {index + 1}",
                frequency_hz=analog_rate_hz,
                corners=tuple(_point(corner, unit) for corner in plate["corners"].T),
                origin=_point(plate["origin"], unit),
                channels=force_channels(force_unit, moment_unit),
                analog_channel_ids=tuple(str(channel) for channel in ids[:, index] if channel > 0),
                calibration_matrix=tuple(tuple(map(float, row)) for row in rows),
            )
        )
    return Parameters(
        markers=Parameters3D(frequency_hz=point_rate_hz, unit=unit, markers=markers),
        tools=Parameters6D(),
        analog=ParametersAnalog(channels),
        force=ParametersForce(tuple(plates)),
    )


def _point(position: Any, unit: str) -> Point:
    x, y, z = map(float, position)
    return Point(x, y, z, unit)


def _number(group: Any, name: str) -> float:
    """Return a group's scalar parameter, 0.0 if it has no value."""
    values = group[name]["value"]
    return float(values[0]) if len(values) else 0.0


_COUNT_OFFSET: Final = 300
"""Where the header has the number of its events. It has room for 18."""
_MAX_HEADER_EVENTS: Final = 18
_SECOND_US: Final = 1_000_000
_SAME_TIME_S: Final = 1e-4
"""Times in C3D are minutes and float32 seconds: after an hour, they differ by so much from what was meant."""
_NO_LABEL: Final = "Event"


class _Texts(NamedTuple):
    """The times of events in s, and their texts, "" where an event has none."""

    seconds: npt.NDArray[np.float64]
    labels: list[str]
    contexts: list[str]
    subjects: list[str]
    descriptions: list[str]


def _read_events(
    path: Path, content: Any, head: bytes, frame_rate_hz: float, length_s: float
) -> tuple[ParametersEvents, Items]:
    """Return the events of the group EVENT, or else those of the header, in µs since the first frame.

    ``content`` is what ezc3d reads, ``head`` has the first block of the file. Times count from frame 1 of the
    trial (Vicon, Qualisys), also if the file begins with a later frame, or else from the first frame of the
    file: what places more events in it.
    """
    texts = _from_group(content["parameters"].get("EVENT", {})) or _from_header(content["header"], head)
    if texts is None:
        return ParametersEvents(), NO_EVENTS
    period_s = 1.0 / frame_rate_hz
    starts_s = [(number - 1) * period_s for number in _first_frames(content)]
    choices_s = [texts.seconds - start_s for start_s in (*starts_s, 0.0)]
    within = [(seconds > -period_s) & (seconds < length_s + period_s) for seconds in choices_s]
    best = int(np.argmax([each.sum() for each in within]))
    (chosen,) = np.nonzero(within[best])
    # A frame has the events up to its own time, so those after the last frame would come in the next pass.
    seconds = np.clip(choices_s[best], 0.0, max(length_s - period_s, 0.0))
    moved_s = np.abs(seconds - choices_s[best])[chosen]
    count, moved_ms = len(texts.seconds), 1e3 * moved_s.max(initial=0.0)
    if num_moved := int((moved_s > _SAME_TIME_S).sum()):
        _log.warning(
            "%s: %d of %d events are before the first frame or after the last one; they are played with "
            "that frame, up to %.1f ms from their time",
            *(path, num_moved, count, moved_ms),
        )
    chosen = chosen[np.argsort(seconds[chosen], kind="stable")]
    if left_out := count - len(chosen):
        _log.warning("%s: %d of %d events are outside of its frames and are left out", path, left_out, count)
    definitions, numbers = _define(texts)
    items = np.full(len(chosen), UNUSED, LONG_EVENT)
    items["timestamp"] = np.round(seconds[chosen] * _SECOND_US)
    for name, values in numbers.items():
        items[name] = values[chosen]
    return definitions, items


def _parts(group: Any, name: str) -> list[Any]:
    """Return the values of a parameter and of its continuations: LABELS, LABELS2, … (255 texts each)."""
    names = (name, *(f"{name}{number}" for number in range(2, 100)))
    return [group[part]["value"] for part in takewhile(lambda part: part in group, names)]


def _texts_of(group: Any, name: str, count: int) -> list[str]:
    """Return ``count`` texts of a parameter, "" for those that are missing."""
    texts = [text.strip() for values in _parts(group, name) for text in values]
    return texts[:count] + [""] * (count - len(texts))


def _from_group(group: Any) -> _Texts | None:
    """Return the events of the group EVENT, whose times are minutes and seconds; None if it has none."""
    num_labels = sum(map(len, _parts(group, "LABELS")))
    times = [np.asarray(part, np.float64) for part in _parts(group, "TIMES")]
    if len(times) == 1 and times[0].ndim == 1 and num_labels == times[0].size:
        seconds = times[0]  # as some programs write them
    else:
        minutes_and_seconds = [part[: part.size // 2 * 2].reshape(2, -1) for part in times if part.size]
        seconds = np.concatenate([[60.0, 1.0] @ part for part in minutes_and_seconds] or [np.zeros(0)])
    if "USED" in group and len(group["USED"]["value"]):
        seconds = seconds[: int(group["USED"]["value"][0]) & 0xFFFF]
    names = ("LABELS", "CONTEXTS", "SUBJECTS", "DESCRIPTIONS")
    texts = (_texts_of(group, name, len(seconds)) for name in names)
    return _Texts(seconds, *texts) if len(seconds) else None


def _from_header(header: Any, head: bytes) -> _Texts | None:
    """Return the events of the header; None if it has none."""
    count = max(head[_COUNT_OFFSET : _COUNT_OFFSET + 2])  # one of both bytes is 0
    if not 0 < count <= _MAX_HEADER_EVENTS:
        return None
    events, none = header["events"], [""] * count
    labels = [text.strip("\0 ") for text in events["events_label"][:count]] + none
    return _Texts(np.array(events["events_time"][:count], np.float64), labels[:count], none, none, none)


def _first_frames(content: Any) -> list[int]:
    """Return the number of the first frame in TRIAL:ACTUAL_START_FIELD, if it is there, and in the header."""
    numbers = [int(content["header"]["points"]["first_frame"]) + 1]
    field = content["parameters"].get("TRIAL", {}).get("ACTUAL_START_FIELD", {"value": []})["value"]
    if len(field):
        words = [int(word) & 0xFFFF for word in np.ravel(field)[:2]]
        numbers.insert(0, words[0] + (words[1] << 16 if len(words) > 1 else 0))
    return numbers


def _define(texts: _Texts) -> tuple[ParametersEvents, dict[str, npt.NDArray[np.int64]]]:
    """Return a definition for each label, and the fields of the events: their ids, context and subject."""
    labels = [label or _NO_LABEL for label in texts.labels]
    # A description of a single event, such as the number of a plate, is not that of all.
    descriptions: dict[str, set[str]] = {}
    for label, description in zip(labels, texts.descriptions, strict=True):
        descriptions.setdefault(label, set()).add(description)
    parameters: list[EventParameter] = []
    numbers: dict[str, npt.NDArray[np.int64]] = {}
    for name, values in (("Context", texts.contexts), ("Subject", texts.subjects)):
        different = [text for text in dict.fromkeys(values) if text]
        if different:
            number = len(parameters) + 1
            codes = {text: code for code, text in enumerate(different, start=1)}
            expected = tuple(ExpectedValue(str(code), str(code), text) for text, code in codes.items())
            parameters.append(EventParameter(str(number), "int", name, expected))
            numbers[f"param{number}"] = np.array([codes.get(text, UNUSED) for text in values])
    ids = {label: number for number, label in enumerate(dict.fromkeys(labels), start=1)}
    numbers["id"] = np.array([ids[label] for label in labels])
    definitions = tuple(
        EventDefinition(str(number), label, common(descriptions[label]) or "", tuple(parameters))
        for label, number in ids.items()
    )
    return ParametersEvents(definitions), numbers
