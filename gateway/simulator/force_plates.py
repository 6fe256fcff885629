"""Force plates that a person walks over."""

from typing import Final

import numpy as np

from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, Items
from gateway.rtc3d.parameters import ForceChannel, ParametersForce, Plate, Point
from gateway.rtc3d_server.scene import SampleNumbers
from gateway.simulator.noise import Noise

_WIDTH_MM: Final = 400.0
_LENGTH_MM: Final = 600.0
_PITCH_MM: Final = 610.0  # distance of two plates in the direction of walking, +Y
_STRIDE_S: Final = 1.2  # time between two steps of the same foot
_STANCE_S: Final = 0.72  # how long the foot is on the plate in each stride
_WEIGHT_N: Final = 800.0
_NOISE_N: Final = 0.5
_CHANNELS: Final = tuple(
    ForceChannel(id=str(number), label=label, unit=unit)
    for number, (label, unit) in enumerate(
        [
            ("Force X", "N"),
            ("Force Y", "N"),
            ("Force Z", "N"),
            ("Moment X", "Nm"),
            ("Moment Y", "Nm"),
            ("Moment Z", "Nm"),
        ],
        start=1,
    )
)


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
    return Plate(
        id=str(index + 1),
        label=f"Force plate {index + 1}",
        frequency_hz=rate_hz,
        corners=(
            Point(0.0, near, 0.0),
            Point(_WIDTH_MM, near, 0.0),
            Point(_WIDTH_MM, far, 0.0),
            Point(0.0, far, 0.0),
        ),
        origin=Point(0.0, 0.0, 0.0),
        channels=_CHANNELS,
        excitation_voltage_v=5.0,
        amplifier_gain=4000.0,
        calibration_unit="microV",
        calibration_matrix=tuple(tuple(float(row == column) for column in range(6)) for row in range(6)),
    )
