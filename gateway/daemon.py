"""The gateway as a whole: builds the parts from the settings, connects them, runs and stops them."""

import asyncio
import logging
from collections.abc import Sequence
from typing import Any, Final

from gateway.config import Settings
from gateway.outputs.contract import Output
from gateway.outputs.lcm_output import LcmOutput
from gateway.outputs.zenoh_output import ZenohOutput
from gateway.queries.lcm_queries import LcmQueries
from gateway.queries.zenoh_queries import ZenohQueries
from gateway.source_gateway import SourceGateway
from gateway.spool import Spool

_STATUS_PERIOD_S: Final = 1.0
_OPENING_S: Final = 2.0
_OPENING_POLL_S: Final = 0.02

logger = logging.getLogger(__name__)


def build_outputs(settings: Settings) -> list[Output]:
    """Return the outputs that are switched on; raises ConfigError if Zenoh refuses its configuration."""
    outputs: list[Output] = []
    if settings.zenoh.enabled:
        outputs.append(ZenohOutput(settings.zenoh))
    if settings.lcm.enabled:
        outputs.append(LcmOutput(settings.lcm))
    return outputs


class Gateway:
    """All sources and all outputs of one configuration; make it in a running event loop.

    ``outputs`` are built from the settings unless given, as the demo and the tests do.
    """

    def __init__(self, settings: Settings, outputs: Sequence[Output] | None = None) -> None:
        self._outputs = build_outputs(settings) if outputs is None else list(outputs)
        tool_outputs = {
            name
            for name, wanted in (("zenoh", settings.zenoh.tool_poses), ("lcm", settings.lcm.tool_poses))
            if wanted
        }
        spool = Spool(settings.spool.effective_directory, settings.spool.max_files, settings.spool.max_bytes)
        self.sources = [
            SourceGateway(source, self._outputs, tool_outputs, spool, self._tell_parameters, self._tell_file)
            for source in settings.sources
        ]
        desks = {source.source.name: source.desk for source in self.sources}
        self._zenoh_queries: list[ZenohQueries] = []
        self._lcm_queries: list[LcmQueries] = []
        for output in self._outputs:
            if isinstance(output, ZenohOutput):
                zenoh_queries = ZenohQueries(output.settings.prefix, desks)
                output.when_open(zenoh_queries.declare)
                self._zenoh_queries.append(zenoh_queries)
            elif isinstance(output, LcmOutput):
                lcm_queries = LcmQueries(output.settings, desks, shared=output.is_shared)
                output.when_open(lcm_queries.declare)
                self._lcm_queries.append(lcm_queries)

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then say Bye to every server and close the outputs."""
        for output in self._outputs:
            output.start()
        try:
            await self._outputs_open()
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
            for source in self.sources:
                source.close()
            for queries in self._queries:
                await queries.close()
            for output in self._outputs:
                output.close()

    async def _outputs_open(self) -> None:
        """Wait until frames can go out, but not for long: one side may be away while the other works."""
        deadline_s = asyncio.get_running_loop().time() + _OPENING_S
        while asyncio.get_running_loop().time() < deadline_s:
            if all(output.health().connected for output in self._outputs):
                return
            await asyncio.sleep(_OPENING_POLL_S)

    async def _keep_status(self) -> None:
        while True:
            await asyncio.sleep(_STATUS_PERIOD_S)
            for output in self._outputs:
                output.maintain()
            for source in self.sources:
                source.publish_status()
            for lcm_queries in self._lcm_queries:
                lcm_queries.maintain()

    @property
    def _queries(self) -> list[ZenohQueries | LcmQueries]:
        return [*self._zenoh_queries, *self._lcm_queries]

    def _tell_parameters(self, source: str, xml: bytes) -> None:
        for queries in self._queries:
            queries.tell_parameters(source, xml)

    def _tell_file(self, source: str, description: dict[str, Any]) -> None:
        for queries in self._zenoh_queries:
            queries.tell_file(source, description)
