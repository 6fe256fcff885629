"""What the simulator plays: the contract between a scene and the server."""

from collections.abc import Mapping
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import LONG_EVENT, ComponentType, Items
from gateway.rtc3d.parameters import Parameters

Samples = npt.NDArray[np.int64]
"""Numbers of samples of one component, shape (count,), counted from 0 at the start of the measurement."""

NO_EVENTS: Final = np.zeros(0, LONG_EVENT)


class Scene(Protocol):
    """A measurement that the simulator plays, as a function of time alone.

    It never blocks, and the same question always has the same answer, so that all clients see one
    scene however their streams differ.
    """

    @property
    def parameters(self) -> Parameters:
        """All sections of §6 but General, which is the server's own."""
        ...

    @property
    def rates_hz(self) -> Mapping[ComponentType, float]:
        """The rate of each measured component that the scene has; one without items is not in it."""
        ...

    @property
    def measurement_rate_hz(self) -> float:
        """The rate of real-time frames, which is also that of streams of nothing but events."""
        ...

    @property
    def num_frames(self) -> int | None:
        """How many frames at ``measurement_rate_hz`` one pass has; None if the scene has no end."""
        ...

    def items(self, component: ComponentType, samples: Samples) -> Items:
        """Return a measured component's items, shape (len(samples), number of items).

        The dtype is that of ITEM_DTYPES. Samples past the end of a pass begin it again.
        """
        ...

    def events(self, start_us: int, stop_us: int) -> Items:
        """Return the events (LONG_EVENT) with time stamps in [start_us, stop_us), in order."""
        ...
