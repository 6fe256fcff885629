"""What moves in a synthetic scene: rigid bodies with markers and tools, force plates, and their noise."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import ITEM_DTYPES, MISSING, MISSING_MARKER, ComponentType, Items
from gateway.rtc3d.parameters import ForceChannel, ParametersForce, Plate, Point
from gateway.session.server.scene import SampleNumbers

Floats = npt.NDArray[np.floating[Any]]
_Integers = npt.NDArray[np.int64]

_TABLE_SIZE: Final = 2**16
_STRIDE: Final = 7919  # odd, so that a column reads the whole table before it repeats


class Noise:
    """Normally distributed noise of standard deviation 1, always the same for the same sample number.

    All ``width`` columns read the same table of random numbers, each from its own position. This is much
    cheaper than a generator per sample, and repeats only after 65536 samples.
    """

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._table = rng.standard_normal(_TABLE_SIZE, dtype=np.float32)
        self._columns = rng.integers(0, _TABLE_SIZE, width)

    def __call__(self, samples: SampleNumbers) -> Floats:
        """Return the noise of each sample, shape (len(samples), width)."""
        positions: _Integers = (samples[:, None] * _STRIDE + self._columns) & (_TABLE_SIZE - 1)
        return self._table.take(positions)


_MARKERS_PER_BODY: Final = 4
_BODY_RADIUS_MM: Final = 80.0
_NOISE_MM: Final = 0.1
_MIN_VISIBLE_MARKERS: Final = 3
_MARKER_HIDDEN: Final = 0.02  # the share of time that a single marker is out of view
_BODY_HIDDEN: Final = 0.03  # the share of time that all markers of a body are out of view together
_MARKER_ITEM: Final = ITEM_DTYPES[ComponentType.MARKERS]
_TOOL_ITEM: Final = ITEM_DTYPES[ComponentType.TOOLS]
_Booleans = npt.NDArray[np.bool_]


class RigidBodies:
    """Bodies that swing about their own axis while their centres move on smooth curves.

    Each body has four markers, and the last body also has the remaining ones; with fewer than four
    markers there is one body. Tools are assigned to the bodies in turn, each with its own origin and
    orientation on the body. So any numbers of markers and tools are possible.
    """

    def __init__(self, num_markers: int, num_tools: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz = rate_hz
        bodies = max(1, num_markers // _MARKERS_PER_BODY)
        body_of_marker = np.minimum(np.arange(num_markers) // _MARKERS_PER_BODY, bodies - 1)
        body_of_tool = np.arange(num_tools) % bodies
        self._first_markers = np.arange(bodies) * _MARKERS_PER_BODY
        self.tool_markers: _Booleans = body_of_marker[:, None] == body_of_tool
        """Whether each marker belongs to each tool, shape (markers, tools)."""

        # A scene is the same for the same seed only as long as random numbers are drawn in this order.
        travel = _Waves(rng, (bodies, 3), amplitude=(50.0, 300.0), period_s=(2.0, 9.0))
        swing = _Waves(rng, (bodies,), amplitude=(0.3, 1.5), period_s=(1.5, 6.0))
        self._hiding = _Hiding(rng, body_of_marker, bodies)
        self._noise = Noise(rng, num_markers * 3)

        centre_mm = rng.uniform((-1000.0, -1000.0, 500.0), (1000.0, 1000.0, 1500.0), (bodies, 3))
        self._motion = _Motion(centre_mm, travel, _normalised(rng.standard_normal((bodies, 3))), swing)
        # No four consecutive directions are close to one line or plane.
        corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3)
        directions = corners[np.arange(num_markers) % 4] + rng.uniform(-0.3, 0.3, (num_markers, 3))
        self._markers = self._motion.attached(_BODY_RADIUS_MM * directions, body_of_marker)
        origin_mm = rng.uniform(-20.0, 20.0, (num_tools, 3))
        self._origins = self._motion.attached(origin_mm, body_of_tool)
        # A tool's quaternion is the body's, (cos a/2, axis · sin a/2), times its own on the body.
        own = _normalised(rng.standard_normal((num_tools, 4)))
        axis = self._motion.axis[body_of_tool]
        self._quaternion_cos = own
        scalar = -np.sum(axis * own[:, 1:], axis=1, keepdims=True)
        vector = own[:, :1] * axis + np.cross(axis, own[:, 1:])
        self._quaternion_sin = np.concatenate([scalar, vector], axis=1)

    def markers(self, samples: SampleNumbers) -> Items:
        """Return the 3D items, shape (len(samples), markers), in mm."""
        time_s = samples / self._rate_hz
        noise_mm = self._noise_mm(samples)
        position_mm = self._motion.positions_mm(time_s, self._markers)
        values = np.empty((*noise_mm.shape[:2], 4), np.float32)
        np.add(position_mm, noise_mm, out=values[..., :3], casting="same_kind")
        values[..., 3] = np.sqrt(_square_sum(noise_mm))
        values[self._hiding(time_s)] = MISSING_MARKER
        return values.astype(">f4").view(_MARKER_ITEM)[..., 0]

    def tools(self, samples: SampleNumbers) -> Items:
        """Return the 6D items, shape (len(samples), tools), in mm.

        The pose is that of the body without noise. Its error is the RMS distance of the visible markers
        from where the pose puts them. With fewer than three visible markers, the tool is missing.
        """
        time_s = samples / self._rate_hz
        half = self._motion.swing(time_s).take(self._origins.body, axis=1)[..., None] / 2
        visible = ~self._hiding(time_s)
        num_visible = self._sum_per_tool(visible.astype(np.float32))
        square_mm = self._sum_per_tool(_square_sum(self._noise_mm(samples)) * visible)
        values = np.empty((*num_visible.shape, 8), np.float32)
        values[..., :4] = self._quaternion_cos * np.cos(half) + self._quaternion_sin * np.sin(half)
        values[..., 4:7] = self._motion.positions_mm(time_s, self._origins)
        values[..., 7] = np.sqrt(square_mm / np.maximum(num_visible, 1))
        values[num_visible < _MIN_VISIBLE_MARKERS] = MISSING
        return values.astype(">f4").view(_TOOL_ITEM)[..., 0]

    def _sum_per_tool(self, per_marker: Floats) -> Floats:
        """Return the sum of ``per_marker`` over the markers of each tool, shape (samples, tools).

        ``per_marker`` has the shape (samples, markers).
        """
        if per_marker.shape[1] == 0:
            return np.zeros((len(per_marker), len(self._origins.body)))
        # Not a matrix product: its rounding would depend on the number of samples in one call.
        sums: Floats = np.add.reduceat(per_marker, self._first_markers, axis=1)
        return sums.take(self._origins.body, axis=1)

    def _noise_mm(self, samples: SampleNumbers) -> Floats:
        return _NOISE_MM * self._noise(samples).reshape(len(samples), len(self._markers.body), 3)


class _Waves:
    """Sine waves, one for each element of ``shape``, with random amplitude, period and phase.

    ``amplitude`` and ``period_s`` are ranges.
    """

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


class _BodyPoints(NamedTuple):
    """Points that are fixed to bodies. ``body`` is the number of each point's body, shape (points,).

    By Rodrigues' formula, along + across · cos a + beside · sin a, each of shape (points, 3), is the point
    rotated about the body's axis by the angle a.
    """

    body: _Integers
    along: Floats
    across: Floats
    beside: Floats


class _Motion(NamedTuple):
    """How bodies move: their centres travel around ``centre_mm`` while they swing about their ``axis``."""

    centre_mm: Floats
    travel: _Waves
    axis: Floats
    swing: _Waves

    def attached(self, local_mm: Floats, body: _Integers) -> _BodyPoints:
        """Return the points that are fixed to bodies at ``local_mm`` from their centres."""
        axis = self.axis[body]
        along = axis * np.sum(axis * local_mm, axis=1, keepdims=True)
        return _BodyPoints(body, along, local_mm - along, np.cross(axis, local_mm))

    def positions_mm(self, time_s: Floats, points: _BodyPoints) -> Floats:
        """Return where points are, shape (len(time_s), points, 3)."""
        body, along, across, beside = points
        angle = self.swing(time_s)
        # take() and in-place sums are several times faster than array indexing and temporary arrays.
        position_mm: Floats = (self.centre_mm + self.travel(time_s)).take(body, axis=1)
        position_mm += along
        position_mm += across * np.cos(angle).take(body, axis=1)[..., None]
        position_mm += beside * np.sin(angle).take(body, axis=1)[..., None]
        return position_mm


class _Hiding:
    """Which markers are out of view: single ones, and all of a body together."""

    def __init__(self, rng: np.random.Generator, body_of_marker: _Integers, bodies: int) -> None:
        self._body_of_marker = body_of_marker
        self._marker = _Waves(rng, (len(body_of_marker),), amplitude=(1.0, 1.0), period_s=(6.0, 16.0))
        self._body = _Waves(rng, (bodies,), amplitude=(1.0, 1.0), period_s=(9.0, 21.0))

    def __call__(self, time_s: Floats) -> _Booleans:
        """Return whether each marker is out of view, shape (len(time_s), markers)."""
        marker: _Booleans = self._marker(time_s) > np.cos(np.pi * _MARKER_HIDDEN)
        body: _Booleans = self._body(time_s) > np.cos(np.pi * _BODY_HIDDEN)
        return marker | body.take(self._body_of_marker, axis=1)


def _square_sum(vectors: Floats) -> Floats:
    """Return the squared lengths of ``vectors``, which have the shape (…, 3)."""
    squares: npt.NDArray[Any] = np.einsum("...i,...i->...", vectors, vectors)
    return squares


def _normalised(vectors: Floats) -> Floats:
    unit: npt.NDArray[Any] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


_WIDTH_MM: Final = 400.0
_LENGTH_MM: Final = 600.0
_PITCH_MM: Final = 610.0  # distance of two plates in the direction of walking, +Y
_STRIDE_S: Final = 1.2  # time between two steps of the same foot
_STANCE_S: Final = 0.72  # how long the foot is on the plate in each stride
_WEIGHT_N: Final = 800.0
_NOISE_N: Final = 0.5


class ForcePlates:
    """Plates in a row. A foot is on each plate once per stride, half a stride later than on the previous one.

    Forces (N) are those of the plate on the foot, +Z up. Moments (N·m) are about the centre of the
    plate's surface, so the centre of pressure is x = -My / Fz, y = Mx / Fz, in metres from that centre.
    """

    def __init__(self, num_plates: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz = rate_hz
        self._delay_s = _STRIDE_S / 2 * np.arange(num_plates)
        self._noise = Noise(rng, num_plates * 3)
        self.parameters = ParametersForce(tuple(_plate(index, rate_hz) for index in range(num_plates)))

    def forces(self, samples: SampleNumbers) -> Items:
        """Return the Force items, shape (len(samples), plates)."""
        time_s = samples[:, None] / self._rate_hz - self._delay_s
        stance = np.minimum(time_s % _STRIDE_S / _STANCE_S, 1.0)  # 0 at heel strike, 1 from toe off on
        step = np.sin(np.pi * stance)
        swing = np.sin(2 * np.pi * stance)
        force_n = _NOISE_N * self._noise(samples).reshape(*time_s.shape, 3)
        force_n[..., 0] += 0.04 * _WEIGHT_N * step
        force_n[..., 1] -= 0.18 * _WEIGHT_N * swing  # the foot brakes, then pushes off
        force_n[..., 2] += 1.17 * _WEIGHT_N * (step + 0.33 * np.sin(3 * np.pi * stance))  # two peaks
        x_m = 0.01 * step
        y_m = -0.11 + 0.23 * stance  # from heel to toe
        values = np.empty((*time_s.shape, 6), ">f4")
        values[..., :3] = force_n
        values[..., 3] = y_m * force_n[..., 2]
        values[..., 4] = -x_m * force_n[..., 2]
        values[..., 5] = x_m * force_n[..., 1] - y_m * force_n[..., 0] + 3.0 * swing
        return values.view(ITEM_DTYPES[ComponentType.FORCE])[..., 0]


def _plate(index: int, rate_hz: float) -> Plate:
    near, far = _PITCH_MM * index, _PITCH_MM * index + _LENGTH_MM
    corners = ((0.0, near), (_WIDTH_MM, near), (_WIDTH_MM, far), (0.0, far))
    return Plate(
        id=str(index + 1),
        label=f"Force plate {index + 1}",
        frequency_hz=rate_hz,
        corners=tuple(Point(x, y, 0.0) for x, y in corners),
        origin=Point(0.0, 0.0, 0.0),
        channels=force_channels("N", "Nm"),
        excitation_voltage_v=5.0,
        amplifier_gain=4000.0,
        calibration_unit="microV",
        calibration_matrix=tuple(tuple(float(row == column) for column in range(6)) for row in range(6)),
    )


def force_channels(force_unit: str, moment_unit: str) -> tuple[ForceChannel, ...]:
    """Return the channels of a plate, in the order of the items of the Force component (§7.5)."""
    kinds = (("Force", force_unit), ("Moment", moment_unit))
    channels = [(f"{kind} {axis}", unit) for kind, unit in kinds for axis in "XYZ"]
    return tuple(ForceChannel(str(number), *channel) for number, channel in enumerate(channels, start=1))
