"""Which axis of the laboratory points up, and what follows from it."""

from collections.abc import Iterable
from typing import Final, Literal

from gateway.descriptions.plate_forces import placed_plates
from gateway.rtc3d.parameters import Parameters

UpAxis = Literal["x", "y", "z"]
UP_AXES: Final[tuple[UpAxis, ...]] = ("z", "y", "x")
PLANES: Final[dict[UpAxis, Literal["xy", "zx", "yz"]]] = {"z": "xy", "y": "zx", "x": "yz"}
"""The floor for each axis that points up; seen from above, the second axis is left of the first one."""

_VERTICAL: Final = 0.95
"""The cosine from which a plate counts as horizontal."""


def on_floor(up: UpAxis, first: float, second: float, height: float = 0.0) -> tuple[float, float, float]:
    """Return a position by its coordinates on the two axes of the floor and above it."""
    by_axis = dict(zip((*PLANES[up], up), (first, second, height), strict=True))
    return by_axis["x"], by_axis["y"], by_axis["z"]


def up_axis_of(parameters: Iterable[Parameters]) -> UpAxis | None:
    """Return the axis that points up, by the plates: people step on them; None if they do not show it."""
    found: set[UpAxis] = set()
    for each in parameters:
        for plate in placed_plates(each):
            if plate is not None:
                by_size = {axis: abs(part) for axis, part in zip("xyz", plate.normal, strict=True)}
                found |= {axis for axis in UP_AXES if by_size[axis] > _VERTICAL}
    return found.pop() if len(found) == 1 else None
