"""A scene whose markers and tools have other names than another scene's."""

from collections.abc import Sequence
from dataclasses import replace

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import General, Parameters, only_sections
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.rtc3d_server.scene import FrameSource, Scene


class RenamedScene:
    """``scene`` with ``prefix`` before the label of each marker and tool; everything else is the same."""

    def __init__(self, scene: Scene, prefix: str) -> None:
        self._scene = scene
        self._prefix = prefix

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return _renamed(self._scene.parameters, self._prefix)

    @property
    def length_us(self) -> int | None:
        """See Scene."""
        return self._scene.length_us

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """See Scene."""
        parameters = self.parameters
        return encode_parameters(
            only_sections(replace(parameters, general=parameters.general or general), sections)
        )

    def start(self) -> None:
        """See Scene."""
        self._scene.start()

    def advance(self, elapsed_us: int) -> int | None:
        """See Scene."""
        return self._scene.advance(elapsed_us)

    def stop(self) -> None:
        """See Scene."""
        self._scene.stop()

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> FrameSource:
        """See Scene."""
        return self._scene.frames(components, event_bytes)


def _renamed(parameters: Parameters, prefix: str) -> Parameters:
    if parameters.markers is not None:
        markers = tuple(replace(each, label=prefix + each.label) for each in parameters.markers.markers)
        parameters = replace(parameters, markers=replace(parameters.markers, markers=markers))
    if parameters.tools is not None:
        tools = tuple(replace(each, label=prefix + each.label) for each in parameters.tools.tools)
        parameters = replace(parameters, tools=replace(parameters.tools, tools=tools))
    return parameters
