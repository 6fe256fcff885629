"""The contract between a scene and the RT server that serves it."""

from collections.abc import Mapping
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import LONG_EVENT, ComponentType, Items
from gateway.rtc3d.parameters import Parameters

SampleNumbers = npt.NDArray[np.int64]
"""Numbers of samples of one component, shape (count,), counted from 0 at the start of the measurement."""

NO_EVENTS: Final = np.zeros(0, LONG_EVENT)
"""An empty array of events."""


class Scene(Protocol):
    """The content of a measurement: a function of time alone.

    Its methods never block, and always return the same values for the same arguments, so that all clients
    see the same scene even if their streams differ.
    """

    @property
    def parameters(self) -> Parameters:
        """All sections of §6 except General, which the server fills in."""
        ...

    @property
    def rates_hz(self) -> Mapping[ComponentType, float]:
        """The rate in Hz of each measured component of the scene; components without items are missing."""
        ...

    @property
    def measurement_rate_hz(self) -> float:
        """The rate of frames in a measurement, and of streams that have only events."""
        ...

    @property
    def num_frames(self) -> int | None:
        """The number of frames in one pass, at ``measurement_rate_hz``; None if the scene has no end."""
        ...

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """Return a measured component's items, shape (len(samples), number of items).

        The dtype is that of ITEM_DTYPES. The first sample of a pass follows the last one.
        """
        ...

    def events(self, start_us: int, stop_us: int) -> Items:
        """Return the events (LONG_EVENT) with time stamps in [start_us, stop_us), in order."""
        ...
