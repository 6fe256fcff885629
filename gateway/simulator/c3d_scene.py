"""A C3D recording as a scene: points, analog channels and force plates, read with ezc3d."""

import logging
import os
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gateway.c3d_files.format_check import HEAD_BYTES, problem_of_c3d
from gateway.config.files import check_is_file
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
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
)
from gateway.rtc3d_server.computed_scene import ComputedScene
from gateway.rtc3d_server.scene import NO_EVENTS, SampleNumbers

_FORCE_LABELS: Final = ("Force X", "Force Y", "Force Z", "Moment X", "Moment Y", "Moment Z")
_INSTALL: Final = "pip install 'rtc3d-gateway[c3d]'"
_log = logging.getLogger(__name__)


class C3dScene(ComputedScene):
    """The scene in a C3D file, which starts again after its last frame.

    Every value is what ezc3d reads, as float32. A marker with any NaN or with a residual of -1 is
    missing, with the bytes of §7.3 and field note 7. Markers and channels have the order of POINT:LABELS
    and ANALOG:LABELS.
    """

    def __init__(self, path: Path) -> None:
        """Read the whole file. Raises TakeError if it cannot be played."""
        content = _read(path)
        try:
            self._load(content)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise TakeError(
                f"{path} lacks required C3D data ({type(error).__name__}: {error}); "
                "open it in the software that recorded it and export it again"
            ) from error
        if not self.rates_hz:
            raise TakeError(f"{path} has neither markers nor analog channels; choose another file")
        if min(*self.rates_hz.values(), self.measurement_rate_hz) <= 0:
            raise TakeError(f"{path} has no rate for its data (POINT:RATE, ANALOG:RATE); export it again")

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """See SceneFunction."""
        items = self._items[component]
        return items.take(samples, axis=0, mode="wrap")

    def events(self, start_us: int, stop_us: int) -> Items:  # noqa: ARG002 - a take has no events
        """See SceneFunction. A take has none."""
        return NO_EVENTS

    def _load(self, content: Any) -> None:
        parameters, data = content["parameters"], content["data"]
        point, analog = parameters["POINT"], parameters["ANALOG"]
        plates = data.get("platform", [])
        point_rate_hz, analog_rate_hz = _number(point, "RATE"), _number(analog, "RATE")
        rates_hz = {
            ComponentType.MARKERS: point_rate_hz,
            ComponentType.ANALOG: analog_rate_hz,
            ComponentType.FORCE: analog_rate_hz,
        }
        items = {
            ComponentType.MARKERS: _markers(data["points"], data["meta_points"]["residuals"]),
            ComponentType.ANALOG: data["analogs"][0].T.astype(ITEM_DTYPES[ComponentType.ANALOG]),
            ComponentType.FORCE: _forces(plates),
        }
        self._items: dict[ComponentType, Items] = {c: array for c, array in items.items() if array.size}
        self.rates_hz = {component: rates_hz[component] for component in self._items}
        slowest = min(self._items, key=lambda component: rates_hz[component], default=ComponentType.MARKERS)
        self.measurement_rate_hz = rates_hz[slowest]
        self.num_frames = len(items[slowest])
        self.parameters = Parameters(
            markers=_describe_markers(point, data["points"].shape[1], point_rate_hz),
            tools=Parameters6D(),
            analog=_describe_analog(analog, data["analogs"].shape[1], analog_rate_hz),
            force=ParametersForce(
                tuple(
                    _describe_plate(plate, index, parameters["FORCE_PLATFORM"], analog_rate_hz)
                    for index, plate in enumerate(plates)
                )
            ),
            events=ParametersEvents(),
        )


def _read(path: Path) -> Any:
    """Return what ezc3d reads from the file, including force plates if it supports their type."""
    try:
        import ezc3d  # noqa: PLC0415 - an optional extra
    except ImportError as error:
        raise TakeError(f"{path} cannot be played without ezc3d; install it: {_INSTALL}") from error
    try:
        check_is_file(path)
        with path.open("rb") as file:
            # ezc3d never returns from a folder or from GBs of zeros.
            if problem_of_c3d(file.read(HEAD_BYTES), os.fstat(file.fileno()).st_size):
                raise TakeError(f"{path} is not a C3D file; choose another file")
    except OSError as error:
        raise TakeError(f"{path} cannot be read: {error.strerror}; give the path of a C3D file") from error
    try:
        return ezc3d.c3d(str(path), extract_forceplat_data=True)
    except Exception as error:  # noqa: BLE001 - the C++ library does not document its errors
        _log.debug("%s: cannot read its force plates", path, exc_info=error)
    try:
        content = ezc3d.c3d(str(path))
    except Exception as error:
        raise TakeError(f"{path} cannot be read as a C3D file ({error}); choose another file") from error
    _log.warning("%s: ezc3d does not support this type of force plates; playing the file without them", path)
    return content


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


def _describe_markers(point: Any, count: int, rate_hz: float) -> Parameters3D:
    labels, descriptions, units = (_texts(point, name) for name in ("LABELS", "DESCRIPTIONS", "UNITS"))
    return Parameters3D(
        frequency_hz=rate_hz,
        unit=_text(units, 0, "mm"),
        markers=tuple(
            Marker(
                str(index + 1), _text(labels, index, f"Marker {index + 1}"), _text(descriptions, index, "")
            )
            for index in range(count)
        ),
    )


def _describe_analog(analog: Any, count: int, rate_hz: float) -> ParametersAnalog:
    labels, descriptions, units = (_texts(analog, name) for name in ("LABELS", "DESCRIPTIONS", "UNITS"))
    return ParametersAnalog(
        tuple(
            AnalogChannel(
                id=str(index + 1),
                label=_text(labels, index, f"Analog {index + 1}"),
                description=_text(descriptions, index, ""),
                unit=_text(units, index, "mV"),
                frequency_hz=rate_hz,
            )
            for index in range(count)
        )
    )


def _describe_plate(plate: Any, index: int, force_platform: Any, rate_hz: float) -> Plate:
    """Return a plate's parameters; C3D has no label, excitation or gain for plates."""
    units = [plate["unit_force"]] * 3 + [plate["unit_moment"]] * 3
    channels = np.reshape(force_platform["CHANNEL"]["value"], (-1, len(force_platform["TYPE"]["value"])))
    calibration = plate["cal_matrix"]
    return Plate(
        id=str(index + 1),
        label=f"Force plate {index + 1}",
        frequency_hz=rate_hz,
        corners=tuple(_point(corner, plate["unit_position"]) for corner in plate["corners"].T),
        origin=_point(plate["origin"], plate["unit_position"]),
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


def _texts(group: Any, name: str) -> list[str]:
    """Return a parameter's texts, including its continuations: LABELS, LABELS2, … (255 texts each)."""
    texts: list[str] = []
    for part in (name, *(f"{name}{number}" for number in range(2, 100))):
        if part not in group:
            break
        texts.extend(text.strip() for text in group[part]["value"])
    return texts


def _text(texts: list[str], index: int, default: str) -> str:
    return (texts[index] if index < len(texts) else "") or default
