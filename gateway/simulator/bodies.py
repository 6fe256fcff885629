"""Rigid bodies in motion, with the markers on them, now and then out of view, and the tools that they are."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import ITEM_DTYPES, MISSING, MISSING_RELIABILITY, ComponentType, Items
from gateway.rtc3d_server.scene import Samples
from gateway.simulator.noise import Floats, Noise

_MARKERS_PER_BODY: Final = 4
_BODY_RADIUS_MM: Final = 80.0
_NOISE_MM: Final = 0.1
_VISIBLE_FOR_A_POSE: Final = 3
_MARKER_HIDDEN: Final = 0.02  # of the time, marker by marker
_BODY_HIDDEN: Final = 0.03  # of the time, all markers of a body together
_MARKER_ITEM: Final = ITEM_DTYPES[ComponentType.MARKERS]
_TOOL_ITEM: Final = ITEM_DTYPES[ComponentType.TOOLS]
_Booleans = npt.NDArray[np.bool_]


class RigidBodies:
    """Bodies that swing about an axis of their own while they travel on smooth closed curves.

    Every four markers make a body, the last one taking what is left over; with fewer than four
    markers there is one. The tools are dealt out to the bodies in turn, each with an origin and an
    orientation of its own, so there may be any number of either.
    """

    def __init__(self, num_markers: int, num_tools: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz = rate_hz
        bodies = max(1, num_markers // _MARKERS_PER_BODY)
        self._body_of_marker = np.minimum(np.arange(num_markers) // _MARKERS_PER_BODY, bodies - 1)
        self._body_of_tool = np.arange(num_tools) % bodies
        self._first_markers = np.arange(bodies) * _MARKERS_PER_BODY
        self.tool_markers: _Booleans = self._body_of_marker[:, None] == self._body_of_tool
        """Which markers are which tool's, shape (markers, tools)."""

        self._travel = _Waves(rng, (bodies, 3), amplitude=(50.0, 300.0), period_s=(2.0, 9.0))
        self._swing = _Waves(rng, (bodies,), amplitude=(0.3, 1.5), period_s=(1.5, 6.0))
        self._hiding_markers = _Waves(rng, (num_markers,), amplitude=(1.0, 1.0), period_s=(6.0, 16.0))
        self._hiding_bodies = _Waves(rng, (bodies,), amplitude=(1.0, 1.0), period_s=(9.0, 21.0))
        self._noise = Noise(rng, num_markers * 3)

        self._centre_mm = rng.uniform((-1000.0, -1000.0, 500.0), (1000.0, 1000.0, 1500.0), (bodies, 3))
        self._axis = _unit(rng.standard_normal((bodies, 3)))
        self._markers = self._turned(_BODY_RADIUS_MM * _spread(num_markers, rng), self._body_of_marker)
        origin_mm = rng.uniform(-20.0, 20.0, (num_tools, 3))
        self._origins = self._turned(origin_mm, self._body_of_tool)
        # A tool's quaternion is the body's, (cos a/2, axis · sin a/2), times the tool's own on the body.
        own = _unit(rng.standard_normal((num_tools, 4)))
        axis = self._axis[self._body_of_tool]
        self._quaternion_cos = own
        self._quaternion_sin = np.concatenate(
            [
                -np.sum(axis * own[:, 1:], axis=1, keepdims=True),
                own[:, :1] * axis + np.cross(axis, own[:, 1:]),
            ],
            axis=1,
        )

    def markers(self, samples: Samples) -> Items:
        """Return the 3D items, shape (len(samples), markers), in mm."""
        time_s = samples / self._rate_hz
        noise_mm = self._noise_mm(samples)
        position_mm = self._positions_mm(time_s, self._markers, self._body_of_marker)
        values = np.empty((*noise_mm.shape[:2], 4), np.float32)
        np.add(position_mm, noise_mm, out=values[..., :3], casting="same_kind")
        values[..., 3] = np.sqrt(_square_sum(noise_mm))
        values[self._hidden(time_s)] = (MISSING, MISSING, MISSING, MISSING_RELIABILITY)
        return values.astype(">f4").view(_MARKER_ITEM)[..., 0]

    def tools(self, samples: Samples) -> Items:
        """Return the 6D items, shape (len(samples), tools), in mm.

        The pose is that of the body without noise; its error is the RMS distance of the visible
        markers from where the pose puts them. Of fewer than three visible markers no pose can be
        told: the tool is missing.
        """
        time_s = samples / self._rate_hz
        half = self._swing(time_s).take(self._body_of_tool, axis=1)[..., None] / 2
        visible = ~self._hidden(time_s)
        num_visible = self._sum_on_tools(visible.astype(np.float32))
        square_mm = self._sum_on_tools(_square_sum(self._noise_mm(samples)) * visible)
        values = np.empty((*num_visible.shape, 8), np.float32)
        values[..., :4] = self._quaternion_cos * np.cos(half) + self._quaternion_sin * np.sin(half)
        values[..., 4:7] = self._positions_mm(time_s, self._origins, self._body_of_tool)
        values[..., 7] = np.sqrt(square_mm / np.maximum(num_visible, 1))
        values[num_visible < _VISIBLE_FOR_A_POSE] = MISSING
        return values.astype(">f4").view(_TOOL_ITEM)[..., 0]

    def _turned(self, local_mm: Floats, body: npt.NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Prepare points on bodies, shape (points, 3), to be turned about the bodies' axes.

        By Rodrigues' formula a point turned by the angle a is along + across · cos a + beside · sin a.
        """
        axis = self._axis[body]
        along = axis * np.sum(axis * local_mm, axis=1, keepdims=True)
        return along, local_mm - along, np.cross(axis, local_mm)

    def _positions_mm(
        self, time_s: Floats, turned: tuple[Floats, Floats, Floats], body: npt.NDArray[np.int64]
    ) -> Floats:
        along, across, beside = turned
        angle = self._swing(time_s)
        # take and sums in place: several times faster than fancy indexing and temporaries
        position_mm: Floats = (self._centre_mm + self._travel(time_s)).take(body, axis=1)
        position_mm += along
        position_mm += across * np.cos(angle).take(body, axis=1)[..., None]
        position_mm += beside * np.sin(angle).take(body, axis=1)[..., None]
        return position_mm

    def _hidden(self, time_s: Floats) -> _Booleans:
        """Return which markers are out of view, shape (len(time_s), markers)."""
        marker: _Booleans = self._hiding_markers(time_s) > np.cos(np.pi * _MARKER_HIDDEN)
        body: _Booleans = self._hiding_bodies(time_s) > np.cos(np.pi * _BODY_HIDDEN)
        return marker | body.take(self._body_of_marker, axis=1)

    def _sum_on_tools(self, per_marker: Floats) -> Floats:
        """Return the sums over each tool's markers, shape (samples, tools), of values of each marker."""
        if per_marker.shape[1] == 0:
            return np.zeros((len(per_marker), len(self._body_of_tool)))
        # not a matrix product: its rounding depends on how many samples are asked for at once
        sums: Floats = np.add.reduceat(per_marker, self._first_markers, axis=1)
        return sums.take(self._body_of_tool, axis=1)

    def _noise_mm(self, samples: Samples) -> Floats:
        return _NOISE_MM * self._noise(samples).reshape(len(samples), len(self._body_of_marker), 3)


class _Waves:
    """Sine waves of random amplitude, period and phase, one for each element of ``shape``."""

    def __init__(
        self,
        rng: np.random.Generator,
        shape: tuple[int, ...],
        amplitude: tuple[float, float],
        period_s: tuple[float, float],
    ) -> None:
        self._amplitude = rng.uniform(*amplitude, shape)
        self._angular_rate = 2 * np.pi / rng.uniform(*period_s, shape)
        self._phase = rng.uniform(0, 2 * np.pi, shape)

    def __call__(self, time_s: Floats) -> Floats:
        """Return the waves' values, shape (len(time_s), *shape)."""
        angle = np.multiply.outer(time_s, self._angular_rate) + self._phase
        values: npt.NDArray[Any] = self._amplitude * np.sin(angle)
        return values


def _spread(count: int, rng: np.random.Generator) -> Floats:
    """Return directions, shape (count, 3), those of any four in a row being far from one line or plane."""
    corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3)
    jitter = rng.uniform(-0.3, 0.3, (count, 3))
    directions: npt.NDArray[Any] = corners[np.arange(count) % 4] + jitter
    return directions


def _square_sum(vectors: Floats) -> Floats:
    """Return the squares of the lengths of vectors, shape (…, 3)."""
    squares: npt.NDArray[Any] = np.einsum("...i,...i->...", vectors, vectors)
    return squares


def _unit(vectors: Floats) -> Floats:
    unit: npt.NDArray[Any] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
