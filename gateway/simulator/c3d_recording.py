"""What a C3D file has, read with ezc3d: points, analog channels, force plates and events."""

import logging
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.errors import TakeError
from gateway.rtc3d.components import ITEM_DTYPES, MISSING, MISSING_RELIABILITY, ComponentType, Items
from gateway.rtc3d.parameters import (
    AnalogChannel,
    ForceChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Point,
)
from gateway.simulator.c3d_events import read_events, texts_of

_HEADER_BYTES: Final = 512
_FORCE_LABELS: Final = ("Force X", "Force Y", "Force Z", "Moment X", "Moment Y", "Moment Z")
_WHOLE_UNITS: Final = {"mill": "mm", "cent": "cm", "mete": "m"}
"""Units that programs cut to four characters (field note 28)."""
_log = logging.getLogger(__name__)


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
    content = _read(path)
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    try:
        recording = _convert(path, content, head)
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


def _read(path: Path) -> Any:
    """Return what ezc3d reads from the file, including force plates if it supports their type."""
    import ezc3d  # noqa: PLC0415 - an optional extra

    try:
        return ezc3d.c3d(str(path), extract_forceplat_data=True)
    except Exception as error:  # noqa: BLE001 - the C++ library does not document its errors
        _raise_memory_error(error)
    try:
        content = ezc3d.c3d(str(path))
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
    plates = data.get("platform", [])
    point_rate_hz, analog_rate_hz = _number(point, "RATE"), _number(analog, "RATE")
    all_rates_hz = {
        ComponentType.MARKERS: point_rate_hz,
        ComponentType.ANALOG: analog_rate_hz,
        ComponentType.FORCE: analog_rate_hz,
    }
    all_items = {
        ComponentType.MARKERS: _markers(data["points"], data["meta_points"]["residuals"]),
        ComponentType.ANALOG: data["analogs"][0].T.astype(ITEM_DTYPES[ComponentType.ANALOG]),
        ComponentType.FORCE: _forces(plates),
    }
    items: dict[ComponentType, Items] = {c: array for c, array in all_items.items() if array.size}
    rates_hz = {component: all_rates_hz[component] for component in items}
    slowest = min(items, key=lambda component: rates_hz[component], default=ComponentType.MARKERS)
    rate_hz, num_frames = all_rates_hz[slowest], len(all_items[slowest])
    length_s = num_frames / rate_hz if rate_hz > 0 else 0.0
    frame_rate_hz = point_rate_hz if point_rate_hz > 0 else rate_hz or 1.0
    definitions, events = read_events(path, content, head, frame_rate_hz, length_s)
    num_points, num_channels = data["points"].shape[1], data["analogs"].shape[1]
    unit = _length_unit(path, point, num_points)
    described = Parameters(
        markers=_describe_markers(point, num_points, point_rate_hz, unit),
        tools=Parameters6D(),
        analog=_describe_analog(path, analog, num_channels, analog_rate_hz),
        force=ParametersForce(
            tuple(
                _describe_plate(plate, index, parameters["FORCE_PLATFORM"], analog_rate_hz, unit)
                for index, plate in enumerate(plates)
            )
        ),
        events=definitions,
    )
    return C3dRecording(described, items, rates_hz, rate_hz, num_frames, events)


def _markers(points: npt.NDArray[np.float64], residuals: npt.NDArray[np.float64]) -> Items:
    """Return the 3D items, shape (frames, markers), from ezc3d's points, shape (4, markers, frames)."""
    values = np.empty((points.shape[2], points.shape[1], 4), ">f4")
    values[..., :3] = points[:3].T
    values[..., 3] = residuals[0].T
    missing = np.isnan(values[..., :3]).any(axis=2) | (values[..., 3] == -1)
    values[missing] = (MISSING, MISSING, MISSING, MISSING_RELIABILITY)
    return values.view(ITEM_DTYPES[ComponentType.MARKERS])[..., 0]


def _forces(plates: list[Any]) -> Items:
    """Return the Force items, shape (samples, plates); ezc3d's force and moment have shape (3, samples)."""
    dtype = ITEM_DTYPES[ComponentType.FORCE]
    if not plates:
        return np.empty((0, 0), dtype)
    values = np.array([np.concatenate([plate["force"], plate["moment"]]) for plate in plates])
    ordered = np.ascontiguousarray(values.transpose(2, 0, 1), dtype=">f4")
    return ordered.view(dtype)[..., 0]


def _length_unit(path: Path, point: Any, num_points: int) -> str:
    """Return the unit of positions; that of nearly all C3D files if this one does not say it."""
    unit = _text(texts_of(point, "UNITS"), 0, "")
    if not unit and num_points:
        _log.warning("%s does not say the unit of its points (POINT:UNITS); mm is assumed", path)
    return _WHOLE_UNITS.get(unit, unit or "mm")


def _describe_markers(point: Any, count: int, rate_hz: float, unit: str) -> Parameters3D:
    labels, descriptions = (texts_of(point, name) for name in ("LABELS", "DESCRIPTIONS"))
    return Parameters3D(
        frequency_hz=rate_hz,
        unit=unit,
        markers=tuple(
            Marker(
                str(index + 1), _text(labels, index, f"Marker {index + 1}"), _text(descriptions, index, "")
            )
            for index in range(count)
        ),
    )


def _describe_analog(path: Path, analog: Any, count: int, rate_hz: float) -> ParametersAnalog:
    labels, descriptions, units = (texts_of(analog, name) for name in ("LABELS", "DESCRIPTIONS", "UNITS"))
    unknown = sum(not _text(units, index, "") for index in range(count))
    if unknown:
        text = "%s does not say the unit of %d of its %d analog channels (ANALOG:UNITS)"
        _log.warning(text, path, unknown, count)
    return ParametersAnalog(
        tuple(
            AnalogChannel(
                id=str(index + 1),
                label=_text(labels, index, f"Analog {index + 1}"),
                description=_text(descriptions, index, ""),
                unit=_text(units, index, ""),
                frequency_hz=rate_hz,
            )
            for index in range(count)
        )
    )


def _describe_plate(plate: Any, index: int, force_platform: Any, rate_hz: float, unit: str) -> Plate:
    """Return a plate's parameters; C3D has no label, excitation or gain for plates."""
    force_unit, moment_unit = plate["unit_force"], plate["unit_moment"]
    if plate["unit_position"] != unit:  # ezc3d says metres if the file says nothing
        moment_unit = f"{force_unit}{unit}"
    units = [force_unit] * 3 + [moment_unit] * 3
    channels = np.reshape(force_platform["CHANNEL"]["value"], (-1, len(force_platform["TYPE"]["value"])))
    calibration = plate["cal_matrix"]
    return Plate(
        id=str(index + 1),
        label=f"Force plate {index + 1}",
        frequency_hz=rate_hz,
        corners=tuple(_point(corner, unit) for corner in plate["corners"].T),
        origin=_point(plate["origin"], unit),
        channels=tuple(
            ForceChannel(str(number), label, unit)
            for number, (label, unit) in enumerate(zip(_FORCE_LABELS, units, strict=True), start=1)
        ),
        analog_channel_ids=tuple(str(channel) for channel in channels[:, index] if channel > 0),
        # for plate types without a calibration matrix, ezc3d returns zeros
        calibration_matrix=tuple(tuple(map(float, row)) for row in calibration) if calibration.any() else (),
    )


def _point(position: Any, unit: str) -> Point:
    x, y, z = map(float, position)
    return Point(x, y, z, unit)


def _number(group: Any, name: str) -> float:
    """Return a group's scalar parameter, 0.0 if it has no value."""
    values = group[name]["value"]
    return float(values[0]) if len(values) else 0.0


def _text(texts: list[str], index: int, default: str) -> str:
    return (texts[index] if index < len(texts) else "") or default
