"""A session of the RT server with one client; the test sets the measurement's time."""

from collections.abc import Sequence

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters import General
from gateway.session.server.client_session import ClientSession
from gateway.session.server.scene import FrameSource
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import COMMAND, DATA, ByteOrder, WireComponent, components_in, packets_in


class ScriptedClient:
    """A client's session on the counting scene, and the measurement's time, which only the test changes."""

    def __init__(self, rate_hz: float = 100.0) -> None:
        self.scene = CountingScene(rate_hz)
        self.elapsed_us: int | None = 0
        self.recording_durations_s: list[float | None] = []
        self.session = ClientSession(self)

    # SessionHost ----------------------------------------------------------------------------

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        return self.scene.frames(components, 24)

    def parameters_xml(self, sections: Sequence[str]) -> bytes:
        return self.scene.parameters_xml(sections, General(name="server under test"))

    def frames_requested(self) -> int | None:
        return self.elapsed_us

    def record_for(self, duration_s: float | None) -> None:
        self.recording_durations_s.append(duration_s)

    # The client -----------------------------------------------------------------------------

    def send(self, text: bytes | str, packet_type: int = COMMAND) -> list[tuple[int, bytes]]:
        body = text.encode() if isinstance(text, str) else text
        return packets_in(b"".join(self.session.answer(Packet(packet_type, body))))

    def frames_until(self, elapsed_us: int, byte_order: ByteOrder = "big") -> list[list[WireComponent]]:
        self.elapsed_us = elapsed_us
        packets = packets_in(b"".join(frame.packet for frame in self.session.due_frames(elapsed_us)))
        assert all(packet_type == DATA for packet_type, _ in packets)
        return [components_in(body, byte_order) for _, body in packets]

    def numbers_until(self, elapsed_us: int) -> list[int]:
        """Return the frame number of each frame's first component."""
        return [frame[0].frame_number for frame in self.frames_until(elapsed_us)]
