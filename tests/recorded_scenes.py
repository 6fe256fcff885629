"""Takes of scenes without a server and a gateway in between: each component in a stream of its own."""

from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np

from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d_server.measurement import exact_rate
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from tests.takes import START_UTIME, Message, description, frame, parameters, write_take

SERVER_START_US = 5_000_000
"""The server's time of the first sample."""


def scene_messages(
    scene: C3dScene | SyntheticScene,
    num_frames: int,
    *,
    source: str = "lab",
    session: int = 1,
    start_us: int = 0,
    sequence: int = 0,
    keep: Callable[[ComponentType, int], bool] = lambda _component, _sample: True,
) -> Iterator[Message]:
    """Yield the messages of so many frames of a scene, with its time stamps, in the order of time.

    ``keep`` says which samples of a component arrive. The times of capture have a jitter of up to 0.4 ms.
    """
    jitter = np.random.default_rng(7)
    slowest = exact_rate(scene.measurement_rate_hz)
    due: list[tuple[Fraction, ComponentType, int]] = []
    items = {}
    for component in WIRE_ORDER:
        if component in scene.rates_hz:
            rate = exact_rate(scene.rates_hz[component])
            count = int(num_frames * rate / slowest)
            items[component] = scene.items(component, np.arange(count))
            due += [(number / rate, component, number) for number in range(count)]
    for time_s, component, number in sorted(due, key=lambda entry: entry[0]):
        if keep(component, number):
            time_us = start_us + int(time_s * 1_000_000)
            yield frame(
                component,
                items[component][number].tolist(),
                sequence + number,
                utime=START_UTIME + time_us + 3000 + int(jitter.integers(400)),
                session=session,
                timestamp_us=SERVER_START_US + time_us,
                frame_number=number + 1,
                source=source,
            )


def record_scene(path: Path, scene: C3dScene | SyntheticScene, num_frames: int) -> Path:
    """Write a take of a scene; return its path."""
    return write_take(path, [description(), parameters(scene.parameters), *scene_messages(scene, num_frames)])
