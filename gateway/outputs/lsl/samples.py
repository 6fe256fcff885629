"""The values of components as samples of LSL streams."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gateway.messages.coordinate_frame import MAX_FLOAT, NO_ROTATION, CoordinateFrame, product
from gateway.rtc3d.components import ComponentType

Values = npt.NDArray[np.float32]
"""Shape (frames, items, channels per item)."""

Numbers = npt.NDArray[np.float64]


def samples(
    component: ComponentType, items: npt.NDArray[Any], frame: CoordinateFrame, num_items: int
) -> npt.NDArray[np.float32]:
    """Return one sample per frame, shape (frames, channels), with ``num_items`` items each.

    ``items`` are the fields of the items of equal components, shape (frames, items, fields). Items that they
    lack are NaN, like those out of view. The unit of length must be known for markers and tools.
    """
    num_frames, present = items.shape[:2]
    with np.errstate(all="ignore"):  # a server may send any values
        values = _VALUES[component](items.astype(np.float64), frame)
        result = np.full((num_frames, num_items, values.shape[2]), np.nan, np.float32)
        result[:, :present] = values
    return result.reshape(num_frames, -1)


def _markers(items: Numbers, frame: CoordinateFrame) -> Numbers:
    items[..., :3] = frame.points(items[..., :3].reshape(-1, 3)).reshape(*items.shape[:2], 3)
    items[~_is_in_range(items[..., :3])] = np.nan
    return items


def _tools(items: Numbers, frame: CoordinateFrame) -> Numbers:
    """Return x, y, z, the quaternion as x, y, z, w, and the error, as ``CoordinateFrame.poses`` does."""
    assert frame.metres_per_unit is not None  # noqa: S101 - the caller has checked it
    q0, qx, qy, qz = (items[..., index] for index in range(4))
    result = np.empty_like(items)
    result[..., :3] = frame.points(items[..., 4:7].reshape(-1, 3)).reshape(*items.shape[:2], 3)
    if frame.rotation_xyzw == NO_ROTATION:
        orientation: Any = (qx, qy, qz, q0)
    else:
        orientation = product(frame.rotation_xyzw, (qx, qy, qz, q0))  # type: ignore[arg-type]  # arrays do, too
    result[..., 3:7] = np.stack(orientation, axis=-1)
    result[..., 7] = items[..., 7] * frame.metres_per_unit
    is_rotation = (items[..., :4] != 0).any(axis=-1)
    result[~(is_rotation & _is_in_range(result))] = np.nan
    return result


def _analog(items: Numbers, _frame: CoordinateFrame) -> Numbers:
    return items


def _force(items: Numbers, frame: CoordinateFrame) -> Numbers:
    return frame.vectors(items.reshape(-1, 3)).reshape(items.shape)


def _is_in_range(values: Numbers) -> npt.NDArray[np.bool_]:
    """Return which items have only numbers that a 32-bit float can hold; comparisons with NaN are false."""
    return np.asarray((abs(values) <= MAX_FLOAT).all(axis=-1))


_VALUES: Final[Mapping[ComponentType, Callable[[Numbers, CoordinateFrame], Numbers]]] = {
    ComponentType.MARKERS: _markers,
    ComponentType.TOOLS: _tools,
    ComponentType.ANALOG: _analog,
    ComponentType.FORCE: _force,
}
