"""The clock of a measurement, and the frames that all clients share."""

import time
from collections.abc import Sequence

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.frame_builder import FrameBuilder, exact_rate, time_us
from gateway.rtc3d_server.scene import Scene


class Measurement:
    """The clock of a measurement of a scene, which can be started and stopped repeatedly.

    ``event_bytes`` is 24 or 16, as in FrameBuilder. With ``once``, time stops after one pass of a scene
    that has an end; otherwise it runs until ``stop``.
    """

    def __init__(self, scene: Scene, *, event_bytes: int, once: bool) -> None:
        self.scene = scene
        self._event_bytes = event_bytes
        self._once = once
        self._frame_builders: dict[frozenset[ComponentType], FrameBuilder] = {}
        self._started_us: int | None = None  # on the monotonic clock; None while no measurement is running
        self.last_us: int | None = None
        """The time of the last µs of the only pass of the scene; None if the measurement has no end."""

    @property
    def is_running(self) -> bool:
        """Whether a measurement is running."""
        return self._started_us is not None

    def start(self) -> None:
        """Start at time 0."""
        self._started_us = _now_us()
        self._frame_builders.clear()
        if self._once and self.scene.num_frames is not None:
            # minus 1, because exactly at the end the first frame of the next pass would be due
            self.last_us = time_us(self.scene.num_frames, exact_rate(self.scene.measurement_rate_hz)) - 1

    def stop(self) -> None:
        """Stop, if it is running."""
        self._started_us = None

    def elapsed_us(self) -> int | None:
        """Return the time since the start in µs, at most ``last_us``; None while none is running."""
        if self._started_us is None:
            return None
        elapsed_us = _now_us() - self._started_us
        return elapsed_us if self.last_us is None else min(elapsed_us, self.last_us)

    def change_scene(self, scene: Scene) -> None:
        """Measure another scene from now on; the time continues."""
        self.scene = scene
        self._frame_builders.clear()

    def frame_builder(self, components: Sequence[ComponentType]) -> FrameBuilder:
        """Return the frame builder of these components; an empty sequence means all.

        Clients with the same components share it.
        """
        choice = frozenset(components)
        if choice not in self._frame_builders:
            self._frame_builders[choice] = FrameBuilder(self.scene, components, self._event_bytes)
        return self._frame_builders[choice]


def _now_us() -> int:
    return time.monotonic_ns() // 1000
