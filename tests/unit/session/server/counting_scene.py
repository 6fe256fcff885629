"""A scene whose values are sample numbers."""

import numpy as np

from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, ComponentType, Items
from gateway.rtc3d.parameters import EventDefinition, Marker, Parameters, Parameters3D, ParametersEvents
from gateway.session.server.measurement import ComputedScene
from gateway.session.server.scene import SampleNumbers

EVENT_EVERY_US = 70_000


class CountingScene(ComputedScene):
    """Markers and one tool at ``rate_hz``, two analog channels at ten times that rate, event k at k · 70 ms.

    The first value of each item is its sample number, from 0.
    """

    def __init__(self, rate_hz: float = 100.0, num_frames: int | None = None, num_markers: int = 2) -> None:
        self._num_markers = num_markers
        self.rates_hz = {
            ComponentType.ANALOG: 10 * rate_hz,
            ComponentType.TOOLS: rate_hz,
            ComponentType.MARKERS: rate_hz,
        }
        self.measurement_rate_hz = rate_hz
        self.num_frames = num_frames
        self.parameters = Parameters(
            markers=Parameters3D(rate_hz, markers=tuple(Marker(f"{k}", f"m{k}") for k in range(num_markers))),
            events=ParametersEvents((EventDefinition("0x1", "Tick"),)),
        )

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        counts = {ComponentType.MARKERS: self._num_markers, ComponentType.TOOLS: 1, ComponentType.ANALOG: 2}
        count, dtype = counts[component], ITEM_DTYPES[component]
        values = np.zeros((len(samples), count, dtype.itemsize // 4), ">f4")
        values[:, :, 0] = samples[:, None]
        if component is ComponentType.MARKERS:
            values[:, 1, 1:] = (1.5, -2.0, 0.25)
        return values.view(dtype)[..., 0]

    def events(self, start_us: int, stop_us: int) -> Items:
        last = stop_us // EVENT_EVERY_US + 1
        numbers = [k for k in range(1, last + 1) if start_us <= k * EVENT_EVERY_US < stop_us]
        return np.array([(k, k * EVENT_EVERY_US, -1, -1, -1) for k in numbers], LONG_EVENT)
