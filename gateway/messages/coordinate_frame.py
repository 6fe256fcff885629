"""Where the positions of a source are in the world: from the server's units and axes to metres."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""

Vector = tuple[float, float, float]

Pose = tuple[float, float, float, float, float, float, float, float]
"""Position in metres (x, y, z), orientation (x, y, z, w), error in metres."""

Coordinates: TypeAlias = npt.NDArray[np.float64]
"""Shape (n, 3)."""

NO_ROTATION: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)
NO_TRANSLATION: Final[Vector] = (0.0, 0.0, 0.0)

MAX_FLOAT: Final = 3.4e38
"""Larger values are out of the range of a 32-bit float."""

_ROUNDING_ERROR: Final = 1e-14
"""Closer than this, an element of a rotation matrix counts as a whole number."""


@dataclass(frozen=True)
class CoordinateFrame:
    """The coordinate frame in which poses and positions of one source are published.

    ``metres_per_unit`` is the length of the server's unit, or a multiple of it if the settings scale it; None
    if the unit is unknown. Positions are first scaled, then rotated, then moved. Component messages keep the
    server's units and axes. ``scale`` is the factor in the settings: 1 m on the server is ``scale`` m here.
    """

    frame_id: str
    metres_per_unit: float | None = 1e-3
    rotation_xyzw: Quaternion = NO_ROTATION
    translation_m: Vector = NO_TRANSLATION
    scale: float = 1.0

    @cached_property
    def matrix(self) -> npt.NDArray[np.float64]:
        """The rotation as a matrix, shape (3, 3); that of quarter turns has only -1, 0 and 1."""
        x, y, z, w = self.rotation_xyzw
        matrix = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        whole = matrix.round() + 0.0  # no -0.0
        return np.where(np.abs(matrix - whole) < _ROUNDING_ERROR, whole, matrix)

    @cached_property
    def only_scales(self) -> bool:
        """Whether positions are neither rotated nor moved."""
        return self.rotation_xyzw == NO_ROTATION and self.translation_m == NO_TRANSLATION

    @property
    def facts(self) -> dict[str, Any]:
        """The frame as JSON can hold it, for peers."""
        return {
            "frame_id": self.frame_id,
            "metres_per_unit": self.metres_per_unit,
            "rotation_xyzw": self.rotation_xyzw,
            "translation_m": self.translation_m,
        }

    def points(self, positions: npt.NDArray[Any]) -> Coordinates:
        """Return positions of the server in metres, in this frame; NaN stays NaN.

        ``positions`` has the shape (…, 3). The unit must be known.
        """
        with np.errstate(invalid="ignore"):  # servers may send infinity, and any bits that are a NaN
            points: Coordinates = positions.astype(np.float64) * self._metres
            return points if self.only_scales else points @ self.matrix.T + self.translation_m

    def vectors(self, vectors: npt.NDArray[Any]) -> Coordinates:
        """Return vectors such as forces, shape (…, 3), with the axes of this frame and in their own unit."""
        with np.errstate(invalid="ignore"):  # as in ``points``
            rotated: Coordinates = vectors.astype(np.float64)
            return rotated if self.rotation_xyzw == NO_ROTATION else rotated @ self.matrix.T

    def poses(self, tools: npt.NDArray[Any], *, accept_zeros: bool = False) -> list[Pose | None]:
        """Return the pose of each tool; None for one out of view. The unit must be known.

        ``tools`` are the items of a 6D component (§7.4), shape (n,). A tool is out of view if any of its
        fields is NaN (field note 7). One whose values a 32-bit float cannot hold counts as out of view, too:
        a robot must never get a pose that is not complete. So does a quaternion of zeros, which is no
        rotation, unless ``accept_zeros``.
        """
        metres = self._metres
        poses = [
            (x * metres, y * metres, z * metres, qx, qy, qz, q0, error * metres)
            for q0, qx, qy, qz, x, y, z, error in tools.tolist()
        ]
        if not self.only_scales:
            tx, ty, tz = self.translation_m
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._rows
            poses = [
                (
                    xx * x + xy * y + xz * z + tx,
                    yx * x + yy * y + yz * z + ty,
                    zx * x + zy * y + zz * z + tz,
                    *product(self.rotation_xyzw, (qx, qy, qz, qw)),
                    error_m,
                )
                for x, y, z, qx, qy, qz, qw, error_m in poses
            ]
        return [pose if _is_complete(pose, accept_zeros) else None for pose in poses]

    @property
    def _metres(self) -> float:
        if self.metres_per_unit is None:
            raise ValueError("the unit of length is unknown")
        return self.metres_per_unit

    @cached_property
    def _rows(self) -> list[list[float]]:
        rows: list[list[float]] = self.matrix.tolist()  # plain numbers are faster than an array, one by one
        return rows


def _is_complete(pose: Pose, accept_zeros: bool) -> bool:
    """Return whether 32-bit floats can hold a pose, and its quaternion is a rotation."""
    # The sum decides nearly always, and is three times as fast. Comparisons with NaN are false.
    if not (sum(map(abs, pose)) <= MAX_FLOAT or all(-MAX_FLOAT <= value <= MAX_FLOAT for value in pose)):
        return False
    return accept_zeros or any(pose[3:7])


def with_offset(pose: Pose, translation_m: Vector, rotation_xyzw: Quaternion) -> Pose:
    """Return the pose of a frame that is moved and then rotated in the frame of ``pose``.

    Its quaternion need not have the length 1.
    """
    x, y, z, qx, qy, qz, qw, error_m = pose
    rotation = (qx, qy, qz, qw)
    squares = qx * qx + qy * qy + qz * qz + qw * qw
    dx, dy, dz, _ = product(product(rotation, (*translation_m, 0.0)), (-qx, -qy, -qz, qw))
    turned = product(rotation, rotation_xyzw)
    return (x + dx / squares, y + dy / squares, z + dz / squares, *turned, error_m)


def product(first: Quaternion, second: Quaternion) -> Quaternion:
    """Return the rotation by ``second``, then by ``first``."""
    x1, y1, z1, w1 = first
    x2, y2, z2, w2 = second
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )
