"""A synthetic scene and its settings: moving tools and markers, sine waves, steps, a button."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, Self

import numpy as np
from pydantic import Field
from typing_extensions import override

from gateway.config.section import Section, expects
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, ComponentType, Items
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    General,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    Tool,
    only_sections,
    relabelled,
)
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.session.server.measurement import ComputedScene
from gateway.session.server.scene import NO_EVENTS, SampleNumbers, Scene
from gateway.simulator.bodies import ForcePlates, Noise, RigidBodies

BUTTON_EVENT: Final = 0x123456
"""The id of the only event, as in §6.6. param1 is the button's number, param2 1 (pressed) or 0 (released)."""

_UNUSED: Final = -1  # 0xFFFFFFFF (§7.7)
_BUTTONS: Final = 2  # pressed in turn
_PERIOD_US: Final = 1_000_000
_PRESSED_US: Final = 500_000  # after the start of each period
_RELEASED_US: Final = 800_000  # likewise


class SyntheticScene(ComputedScene):
    """A scene of any size that never ends, always the same for the same arguments.

    ``markers``, ``tools``, ``analog`` (channels) and ``plates`` are numbers of items and can be 0.
    ``rate_hz`` is the rate of markers and tools, ``analog_rate_hz`` that of analog channels and force
    plates. ``marker_label`` comes before the numbers of markers in their labels. Another ``seed`` gives
    another scene of the same size.
    """

    def __init__(
        self,
        *,
        markers: int = 20,
        tools: int = 2,
        analog: int = 8,
        plates: int = 2,
        rate_hz: float = 100.0,
        analog_rate_hz: float = 1000.0,
        marker_label: str = "Marker",
        seed: int = 1,
    ) -> None:
        rng = np.random.default_rng(seed)
        bodies = RigidBodies(markers, tools, rate_hz, rng)
        channels = _AnalogSines(analog, analog_rate_hz, rng)
        force_plates = ForcePlates(plates, analog_rate_hz, rng)
        components: list[tuple[ComponentType, int, float, Callable[[SampleNumbers], Items]]] = [
            (ComponentType.MARKERS, markers, rate_hz, bodies.markers),
            (ComponentType.TOOLS, tools, rate_hz, bodies.tools),
            (ComponentType.ANALOG, analog, analog_rate_hz, channels.voltages),
            (ComponentType.FORCE, plates, analog_rate_hz, force_plates.forces),
        ]
        self._items = {component: items for component, count, _, items in components if count}
        self.rates_hz = {component: rate for component, count, rate, _ in components if count}
        self.measurement_rate_hz = rate_hz
        described_markers = (
            Marker(str(number), f"{marker_label} {number}") for number in range(1, markers + 1)
        )
        described_tools = (
            Tool(str(number), f"Tool {number}", marker_ids=tuple(map(str, np.flatnonzero(on_tool) + 1)))
            for number, on_tool in enumerate(bodies.tool_markers.T, start=1)
        )
        self.parameters = Parameters(
            markers=Parameters3D(rate_hz, markers=tuple(described_markers)),
            tools=Parameters6D(rate_hz, tuple(described_tools)),
            analog=channels.parameters,
            force=force_plates.parameters,
            events=_EVENTS,
        )

    @override
    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        return self._items[component](samples)

    @override
    def events(self, start_us: int, stop_us: int) -> Items:
        """Once a second, a button is pressed and released."""
        first, stop = _events_before(start_us), _events_before(stop_us)
        if first >= stop:
            return NO_EVENTS
        period, released = np.divmod(np.arange(first, stop), 2)
        events = np.empty(stop - first, LONG_EVENT)
        events["id"] = BUTTON_EVENT
        events["timestamp"] = period * _PERIOD_US + np.where(released, _RELEASED_US, _PRESSED_US)
        events["param1"] = period % _BUTTONS + 1
        events["param2"] = 1 - released
        events["param3"] = _UNUSED
        return events


class _AnalogSines:
    """Analog channels: in each a sine wave of its own frequency, in mV, and noise."""

    def __init__(self, num_channels: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz = rate_hz
        self._amplitude_mv = rng.uniform(200.0, 2000.0, num_channels)
        self._angular_rate = 2 * np.pi * (0.5 + 0.75 * np.arange(num_channels))
        self._noise = Noise(rng, num_channels)
        self.parameters = ParametersAnalog(
            tuple(
                AnalogChannel(str(number), f"Analog {number}", unit="mV", frequency_hz=rate_hz)
                for number in range(1, num_channels + 1)
            )
        )

    def voltages(self, samples: SampleNumbers) -> Items:
        """Return the Analog items, shape (len(samples), channels), in mV."""
        angle = np.multiply.outer(samples / self._rate_hz, self._angular_rate)
        voltage_mv: Items = self._amplitude_mv * np.sin(angle) + 2.0 * self._noise(samples)
        return voltage_mv.astype(ITEM_DTYPES[ComponentType.ANALOG])


def _events_before(time_us: int) -> int:
    """Return the number of button events with time stamps below ``time_us``."""
    period, rest_us = divmod(max(time_us, 0), _PERIOD_US)
    return 2 * period + (rest_us > _PRESSED_US) + (rest_us > _RELEASED_US)


_STATES: Final = (
    ExpectedValue("1", "1", "ON", "Button was pressed"),
    ExpectedValue("2", "0", "OFF", "Button was released"),
)
_BUTTON_PARAMETERS: Final = (
    EventParameter("1", "int", "Button id number"),
    EventParameter("2", "int", "ON/OFF state", _STATES),
)
_EVENTS: Final = ParametersEvents(
    (EventDefinition(f"0x{BUTTON_EVENT:x}", "Button", "Button action", _BUTTON_PARAMETERS),)
)


Size = Annotated[int, Field(strict=True, ge=0, le=10_000), expects("a whole number from 0 to 10000")]
Rate = Annotated[
    float,
    Field(strict=True, ge=0.1, le=100_000, allow_inf_nan=False),
    expects("a number of samples per second from 0.1 to 100000"),
]
Label = Annotated[str, Field(min_length=1, max_length=60), expects("a text of 1 to 60 characters")]
Seed = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1), expects("a whole number, 0 or more")]


class SceneSettings(Section):
    """The arguments of SyntheticScene."""

    markers: Size = 24
    """The number of markers."""

    tools: Size = 4
    """The number of 6D tools."""

    analog: Size = 16
    """The number of analog channels."""

    plates: Size = 2
    """The number of force plates."""

    rate_hz: Rate = 200.0
    """Samples per second of markers and tools."""

    analog_rate_hz: Rate = 2000.0
    """Samples per second of analog channels and force plates."""

    marker_label: Label = "Marker"
    """The text before the number in the markers' labels."""

    seed: Seed = 1
    """Another seed gives another scene of the same size."""

    def with_changes(self, changes: Self) -> Self:
        """Return these settings with the values that ``changes`` sets."""
        return self.model_copy(update={name: getattr(changes, name) for name in changes.model_fields_set})

    def build(self) -> SyntheticScene:
        """Return the scene."""
        return SyntheticScene(**self.model_dump())


class RenamedScene:
    """``scene`` with ``prefix`` before the label of each marker and tool; everything else is the same."""

    def __init__(self, scene: Scene, prefix: str) -> None:
        self._scene = scene
        self._prefix = prefix

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return relabelled(self._scene.parameters, lambda each: self._prefix + each.label)

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """See Scene."""
        parameters = self.parameters
        return encode_parameters(
            only_sections(replace(parameters, general=parameters.general or general), sections)
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)
