"""The gateway as a whole: builds the parts from the settings, connects them, runs and stops them."""

import asyncio
import logging
from collections.abc import Sequence
from typing import Final

from gateway.config import Settings, Source, Stream
from gateway.fanout import FanOut
from gateway.message import Stamp
from gateway.outputs.contract import Output
from gateway.outputs.lcm_output import LcmOutput
from gateway.outputs.zenoh_output import ZenohOutput
from gateway.rtc3d.components import Frame
from gateway.rtc3d.parameters import Parameters
from gateway.session import Handlers
from gateway.status import FrameRate, StreamStatus, status_message
from gateway.supervisor import Supervisor

_STATUS_PERIOD_S: Final = 1.0

logger = logging.getLogger(__name__)


def build_outputs(settings: Settings) -> list[Output]:
    """Return the outputs that are switched on; raises ConfigError if Zenoh refuses its configuration."""
    outputs: list[Output] = []
    if settings.zenoh.enabled:
        outputs.append(ZenohOutput(settings.zenoh))
    if settings.lcm.enabled:
        outputs.append(LcmOutput(settings.lcm))
    return outputs


class _SourceGateway:
    """One source: its streams' supervisors, and the fan-out that they share."""

    def __init__(self, source: Source, outputs: Sequence[Output], tool_outputs: set[str]) -> None:
        self.source = source
        self.fan_out = FanOut(source.name, outputs, tool_outputs)
        self.statuses = [StreamStatus(_components_text(stream)) for stream in source.streams]
        self._rates = [FrameRate() for _ in source.streams]
        self.supervisors = [
            Supervisor(source, stream, status, self._handlers(stream, status))
            for stream, status in zip(source.streams, self.statuses, strict=True)
        ]

    def _handlers(self, stream: Stream, status: StreamStatus) -> Handlers:
        wanted = frozenset(stream.components)
        publish = self.fan_out.publish

        def on_frame(frame: Frame, utime: int) -> None:
            publish(frame, Stamp(utime, utime, status.session), wanted)

        def on_parameters(_xml: bytes, parameters: Parameters) -> None:
            self.fan_out.set_parameters(parameters)

        def on_file(content: bytes) -> None:
            logger.info("%s: a C3D file of %d bytes came; not kept", self.source.name, len(content))

        return Handlers(on_frame, on_parameters, on_file)

    def publish_status(self) -> None:
        """Publish what ``status_t`` holds of this source."""
        rates_hz = [
            rate.update(status.frames_in) for rate, status in zip(self._rates, self.statuses, strict=True)
        ]
        message = status_message(
            source=self.source.name,
            server=f"{self.source.host}:{self.source.port}",
            sequence=self.fan_out.next_status_sequence(),
            streams=list(zip(self.statuses, rates_hz, strict=True)),
            outputs=[(status, output.health()) for output, status in self.fan_out.outputs],
        )
        self.fan_out.publish_status(message.encode())


class Gateway:
    """All sources and all outputs of one configuration.

    ``outputs`` are built from the settings unless given, as the demo and the tests do.
    """

    def __init__(self, settings: Settings, outputs: Sequence[Output] | None = None) -> None:
        self._outputs = build_outputs(settings) if outputs is None else list(outputs)
        tool_outputs = {
            name
            for name, wanted in (("zenoh", settings.zenoh.tool_poses), ("lcm", settings.lcm.tool_poses))
            if wanted
        }
        self.sources = [_SourceGateway(source, self._outputs, tool_outputs) for source in settings.sources]

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then say Bye to every server and close the outputs."""
        for output in self._outputs:
            output.start()
        try:
            async with asyncio.TaskGroup() as tasks:
                running = [
                    tasks.create_task(supervisor.run())
                    for source in self.sources
                    for supervisor in source.supervisors
                ]
                running.append(tasks.create_task(self._keep_status()))
                await stop.wait()
                logger.info("stopping")
                for task in running:
                    task.cancel()
        finally:
            for output in self._outputs:
                output.close()

    async def _keep_status(self) -> None:
        while True:
            await asyncio.sleep(_STATUS_PERIOD_S)
            for output in self._outputs:
                output.maintain()
            for source in self.sources:
                source.publish_status()


def _components_text(stream: Stream) -> str:
    return " ".join(component.key for component in stream.components)
