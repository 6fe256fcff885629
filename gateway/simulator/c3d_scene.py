"""A C3D recording as a scene: points, analog channels, force plates and events."""

from pathlib import Path
from typing import Final

import numpy as np

from gateway.rtc3d.components import ComponentType, Items
from gateway.rtc3d_server.measurement import ComputedScene, exact_rate, time_us
from gateway.rtc3d_server.scene import NO_EVENTS, SampleNumbers
from gateway.simulator.c3d_reader import read_c3d

_SECOND_US: Final = 1_000_000


class C3dScene(ComputedScene):
    """The scene in a C3D file, which starts again after its last frame.

    Every value is what ezc3d reads, as float32. A marker with any NaN or with a residual of -1 is
    missing, with the bytes of §7.3 and field note 7. Markers and channels have the order of POINT:LABELS
    and ANALOG:LABELS.
    """

    num_frames: int

    def __init__(self, path: Path) -> None:
        """Read the whole file. Raises TakeError if it cannot be played."""
        recording = read_c3d(path)
        self._items = recording.items
        self._events = recording.events
        self.rates_hz = recording.rates_hz
        self.measurement_rate_hz = recording.measurement_rate_hz
        self.num_frames = recording.num_frames
        self.parameters = recording.parameters

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """See SceneFunction."""
        items = self._items[component]
        return items.take(samples, axis=0, mode="wrap")

    def events(self, start_us: int, stop_us: int) -> Items:
        """See SceneFunction. Those of the file happen again in each pass."""
        first, stop = self._num_events_before(start_us), self._num_events_before(stop_us)
        if first >= stop:
            return NO_EVENTS
        passes, rows = np.divmod(np.arange(first, stop), len(self._events))
        events: Items = self._events[rows]
        events["timestamp"] += np.array([self._start_us(number) for number in passes.tolist()])
        return events

    def _num_events_before(self, elapsed_us: int) -> int:
        """Return the number of events with time stamps below ``elapsed_us``."""
        rate = exact_rate(self.measurement_rate_hz)
        tick = max(elapsed_us, 0) * rate.numerator // (_SECOND_US * rate.denominator)
        number = tick // self.num_frames
        rest_us = elapsed_us - self._start_us(number)
        return number * len(self._events) + int(np.searchsorted(self._events["timestamp"], rest_us))

    def _start_us(self, number: int) -> int:
        """Return when a pass begins, counted from 0."""
        return time_us(number * self.num_frames, exact_rate(self.measurement_rate_hz))
