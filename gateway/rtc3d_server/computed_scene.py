"""The base of scenes whose frames are computed from the time alone."""

from collections.abc import Sequence
from dataclasses import replace

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import General, only_sections
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.rtc3d_server.frame_builder import FrameBuilder, exact_rate, time_us
from gateway.rtc3d_server.scene import SceneFunction


class ComputedScene(SceneFunction):
    """A Scene that is a SceneFunction: subclasses define what the latter contains."""

    num_frames: int | None = None

    @property
    def length_us(self) -> int | None:
        """See Scene."""
        if self.num_frames is None:
            return None
        return time_us(self.num_frames, exact_rate(self.measurement_rate_hz))

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """See Scene."""
        return encode_parameters(only_sections(replace(self.parameters, general=general), sections))

    def start(self) -> None:
        """See Scene. There is nothing to prepare."""

    def advance(self, elapsed_us: int) -> int | None:  # noqa: ARG002 - there is nothing to prepare
        """See Scene. There is nothing to prepare."""
        return None

    def stop(self) -> None:
        """See Scene. There is nothing to release."""

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> FrameBuilder:
        """See Scene."""
        return FrameBuilder(self, components, event_bytes)
