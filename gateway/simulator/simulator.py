"""The simulator: an RT server that can have faults."""

from gateway.rtc3d_server.scene import Scene
from gateway.rtc3d_server.server import RtServer
from gateway.simulator.faults.control import Faults


class Simulator(RtServer):
    """An RT server that replaces the hardware in tests, and has faults on request.

    RtServer describes the arguments.
    """

    def __init__(
        self,
        scene: Scene,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        event_bytes: int = 24,
        once: bool = False,
    ) -> None:
        self.faults = Faults(self)
        """Begins and ends faults; by default there are none."""
        super().__init__(
            scene,
            host,
            port,
            event_bytes=event_bytes,
            once=once,
            name="RTC3D simulator",
            new_filter=self.faults.new_pipeline,
        )

    async def close(self) -> None:
        """End the faults, stop the measurement, close the connections, and stop listening."""
        await self.faults.close()
        await super().close()
