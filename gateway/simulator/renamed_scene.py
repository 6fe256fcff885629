"""A scene whose markers and tools have other names than another scene's."""

from collections.abc import Mapping
from dataclasses import replace

from gateway.rtc3d.components import ComponentType, Items
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d_server.scene import SampleNumbers, Scene


class RenamedScene:
    """``scene`` with ``prefix`` before the label of each marker and tool; everything else is the same."""

    def __init__(self, scene: Scene, prefix: str) -> None:
        self._scene = scene
        self.rates_hz: Mapping[ComponentType, float] = scene.rates_hz
        self.measurement_rate_hz = scene.measurement_rate_hz
        self.num_frames = scene.num_frames
        self.parameters = _renamed(scene.parameters, prefix)

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """See Scene."""
        return self._scene.items(component, samples)

    def events(self, start_us: int, stop_us: int) -> Items:
        """See Scene."""
        return self._scene.events(start_us, stop_us)


def _renamed(parameters: Parameters, prefix: str) -> Parameters:
    if parameters.markers is not None:
        markers = tuple(replace(each, label=prefix + each.label) for each in parameters.markers.markers)
        parameters = replace(parameters, markers=replace(parameters.markers, markers=markers))
    if parameters.tools is not None:
        tools = tuple(replace(each, label=prefix + each.label) for each in parameters.tools.tools)
        parameters = replace(parameters, tools=replace(parameters.tools, tools=tools))
    return parameters
