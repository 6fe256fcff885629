"""The clock of a measurement, and the frames that all clients share."""

import time
from collections.abc import Sequence
from typing import Final

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.scene import FrameSource, Scene

LEAD_US: Final = 1_000_000
"""With ``once``, a measurement begins this long after a request for frames. So a client with several
connections, such as a gateway, gets the first frames on all of them."""

MAX_LEAD_US: Final = 2_000_000
"""Further requests postpone the beginning, but not for longer than this after the first one."""


class Measurement:
    """The clock of a measurement of a scene, which can be started and stopped repeatedly.

    ``event_bytes`` is 24 or 16, as in Scene. With ``once``, time stops after one pass of a scene
    that has an end; otherwise it runs until ``stop``.
    """

    def __init__(self, scene: Scene, *, event_bytes: int, once: bool) -> None:
        self.scene = scene
        """The scene that clients see."""
        self.advance_us: int | None = None
        """When ``advance`` is to be called again; None for never."""
        self._event_bytes = event_bytes
        self._once = once
        self._frames: dict[frozenset[ComponentType], FrameSource] = {}
        self._played = scene  # the scene at the start, which goes on while faults show another one
        self._started_us: int | None = None  # on the monotonic clock; None while no measurement is running
        self._latest_start_us = 0

    @property
    def is_running(self) -> bool:
        """Whether a measurement is running."""
        return self._started_us is not None

    @property
    def last_us(self) -> int | None:
        """The time of the last µs of the only pass; None if the measurement has no end that is known yet."""
        length_us = self._played.length_us if self._once else None
        # minus 1, because exactly at the end the first frame of the next pass would be due
        return None if length_us is None else length_us - 1

    def start(self) -> None:
        """Start at time 0; with ``once``, at -LEAD_US."""
        now_us = _now_us()
        self._started_us = now_us + LEAD_US if self._once else now_us
        self._latest_start_us = now_us + MAX_LEAD_US
        self._frames.clear()
        self._played = self.scene
        self._played.start()
        self.advance()

    def postpone(self) -> None:
        """Begin LEAD_US from now, if the measurement has not begun yet."""
        now_us = _now_us()
        if self._started_us is not None and now_us < self._started_us:
            self._started_us = min(now_us + LEAD_US, self._latest_start_us)

    def stop(self) -> None:
        """Stop, if it is running."""
        if self._started_us is not None:
            self._started_us = None
            self._played.stop()

    def elapsed_us(self) -> int | None:
        """Return the time since the start in µs, at most ``last_us``; None while none is running."""
        if self._started_us is None:
            return None
        elapsed_us = _now_us() - self._started_us
        last_us = self.last_us
        return elapsed_us if last_us is None else min(elapsed_us, last_us)

    def advance(self) -> None:
        """Prepare the next frames; call it at ``advance_us`` or sooner."""
        elapsed_us = self.elapsed_us()
        self.advance_us = None if elapsed_us is None else self._played.advance(elapsed_us)

    def change_scene(self, scene: Scene) -> None:
        """Show another scene from now on; the time continues."""
        self.scene = scene
        self._frames.clear()

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Return the frames with these components; an empty sequence means all.

        Clients with the same components share them.
        """
        choice = frozenset(components)
        if choice not in self._frames:
            self._frames[choice] = self.scene.frames(components, self._event_bytes)
        return self._frames[choice]


def _now_us() -> int:
    return time.monotonic_ns() // 1000
