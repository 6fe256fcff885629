"""A scene, labels and markers for tests of the export to C3D."""

import math
from typing import Any

import numpy as np

from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.simulator.synthetic import SyntheticScene
from tests.takes import Message, parameters

NAN = math.nan
SCENE = SyntheticScene(markers=5, tools=0, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=5)
PLATES = SCENE.parameters.force.plates if SCENE.parameters.force else ()


def float32(values: Any) -> Any:
    return np.asarray(values).astype(np.float32)


def labelled(*labels: str, unit: str = "mm") -> Message:
    markers = tuple(Marker(str(n), label) for n, label in enumerate(labels))
    return parameters(Parameters(markers=Parameters3D(100.0, unit, markers)))


def visible(*positions: tuple[float, float, float], residual: float = 0.0) -> list[tuple[float, ...]]:
    return [(*position, residual) for position in positions]
