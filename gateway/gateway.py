"""The gateway as a whole: builds the parts from the settings, connects them, changes, runs and stops them."""

import asyncio
import logging
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

from gateway.c3d_spool import Spool
from gateway.config.settings import Settings, SourceSettings
from gateway.monitoring.server import MonitoringServer
from gateway.monitoring.status_line import output_lines
from gateway.outputs.contract import Output
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.queries import LcmQueries
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.queries import ZenohQueries
from gateway.publish.fan_out import FanOut
from gateway.queries.source_queries import SourceQueries
from gateway.source import Source

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

    ``outputs`` are built from the settings unless given, as the demo and the tests do; those given stay.
    """

    def __init__(self, settings: Settings, outputs: Sequence[Output] | None = None) -> None:
        self.settings = settings
        self._given_outputs = outputs
        self._outputs = self._build_outputs(settings)
        self._spool = _spool(settings)
        self._sources: dict[str, Source] = {}
        self._running: dict[str, asyncio.Task[None]] = {}
        self._desks: dict[str, SourceQueries] = {}
        self._drops: defaultdict[str, dict[str, Counter[str]]] = defaultdict(dict)  # by output, then source
        self._queries: dict[str, ZenohQueries | LcmQueries] = {}  # by the output's name
        for source in settings.sources:
            self._add(source)
        for output in self._outputs:
            self._answer_on(output)
        self._watch = MonitoringServer(settings.metrics, self)
        self._tasks = asyncio.TaskGroup()
        self._changing = asyncio.Lock()
        self.opened = asyncio.Event()
        """Set once the outputs are open; 2 s after the start also if not: one side may be away for long."""

    @property
    def sources(self) -> Sequence[Source]:
        """The sources."""
        return list(self._sources.values())

    @property
    def outputs(self) -> Sequence[Output]:
        """The outputs."""
        return self._outputs

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]]:
        """By the output's name, how many of its queries were answered with ok, or with which error."""
        return {name: queries.results for name, queries in self._queries.items()}

    def lines(self) -> list[str]:
        """Return how the gateway is, for people: a line per source, and one per output with a problem."""
        outputs = ((output.name, output.health()) for output in self._outputs)
        return [*(source.line for source in self._sources.values()), *output_lines(outputs)]

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then say Bye to every server and close the outputs."""
        for output in self._outputs:
            output.start()
        await self._watch.start()
        try:
            await self._outputs_open(stop)
            async with self._tasks:
                for name in self._sources:
                    self._start(name)
                status = self._tasks.create_task(self._keep_status())
                self.opened.set()
                await stop.wait()
                await self._changing.acquire()  # for good: what is being changed comes to its end
                logger.info("stopping")
                for task in (status, *self._running.values()):
                    task.cancel()
        finally:
            await self._watch.close()
            await asyncio.gather(*map(self._close, self._outputs))

    async def _outputs_open(self, stop: asyncio.Event) -> None:
        deadline_s = asyncio.get_running_loop().time() + _OPENING_S
        while asyncio.get_running_loop().time() < deadline_s and not stop.is_set():
            if all(output.health().connected for output in self._outputs):
                return
            await asyncio.sleep(_OPENING_POLL_S)

    def _start(self, name: str) -> None:
        self._running[name] = self._tasks.create_task(self._sources[name].run())

    async def _keep_status(self) -> None:
        while True:
            await asyncio.sleep(_STATUS_PERIOD_S)
            for output in self._outputs:
                output.maintain()
            for source in self._sources.values():
                source.publish_status()
            for queries in self._queries.values():
                if isinstance(queries, LcmQueries):
                    queries.maintain()

    async def reload(self, settings: Settings) -> list[str]:
        """Change over to ``settings`` and return what was changed, in words; call it once ``opened``.

        Sources and outputs that are the same before and after notice nothing. A source that differs says
        Bye and connects anew, an output that differs is closed and opened anew; the numbers of messages go
        on. Raises ConfigError, and changes nothing, if Zenoh refuses its configuration.
        """
        outputs = [
            next((running for running in self._outputs if _alike(running, output)), output)
            for output in self._build_outputs(settings)
        ]
        async with self._changing:
            before, self.settings = self.settings, settings
            changes = [*await self._change_outputs(outputs), *await self._change_sources(settings.sources)]
            if settings.spool != before.spool:
                self._spool = _spool(settings)
                for source in self._sources.values():
                    source.spool = self._spool
                changes.append("spool changed")
            if settings.metrics != before.metrics:
                await self._watch.close()
                self._watch = MonitoringServer(settings.metrics, self)
                await self._watch.start()
                changes.append("metrics changed")
            return changes

    def _build_outputs(self, settings: Settings) -> list[Output]:
        return build_outputs(settings) if self._given_outputs is None else list(self._given_outputs)

    async def _change_outputs(self, outputs: list[Output]) -> list[str]:
        gone = [output for output in self._outputs if output not in outputs]
        new = [output for output in outputs if output not in self._outputs]
        self._outputs = outputs
        for source in self._sources.values():
            source.fan_out.use(outputs, self._tool_outputs)
            self._share_drops(source)
        await asyncio.gather(*map(self._close, gone))  # first: the new one may listen at the same address
        for output in new:
            output.start()
            self._answer_on(output)
        return _changes("output", [output.name for output in gone], [output.name for output in new])

    async def _change_sources(self, wanted_sources: Sequence[SourceSettings]) -> list[str]:
        wanted = {source.name: source for source in wanted_sources}
        gone = {name: each for name, each in self._sources.items() if each.source != wanted.get(name)}
        new = [source for name, source in wanted.items() if name in gone or name not in self._sources]
        await asyncio.gather(*map(self._stop, gone))
        for name in gone.keys() - wanted.keys():
            self._remove(name)
        for source in new:
            self._add(source, gone.get(source.name))
            self._start(source.name)
        self._sources = {name: self._sources[name] for name in wanted}
        return _changes("source", gone, [source.name for source in new])

    async def _stop(self, name: str) -> None:
        task = self._running.pop(name)
        task.cancel()
        await asyncio.wait([task])

    def _add(self, source: SourceSettings, before: Source | None = None) -> None:
        fan_out = before.fan_out if before else FanOut(source.name, self._outputs, self._tool_outputs)
        added = Source(source, fan_out, self._spool, self._tell_parameters, self._tell_file, before)
        self._sources[source.name] = added
        self._desks[source.name] = added.desk
        self._share_drops(added)
        for queries in self._queries.values():
            queries.serve(source.name)

    def _remove(self, name: str) -> None:
        del self._desks[name]
        for queries in self._queries.values():
            queries.dismiss(name)
        self._sources.pop(name).fan_out.close()

    def _share_drops(self, source: Source) -> None:
        for output, status in source.fan_out.outputs:
            self._drops[output.name][source.source.name] = status.drops

    @property
    def _tool_outputs(self) -> set[str]:
        sides = (("zenoh", self.settings.zenoh), ("lcm", self.settings.lcm))
        return {name for name, side in sides if side.tool_poses}

    def _answer_on(self, output: Output) -> None:
        """Have questions answered that come on ``output``, and what is known told on it."""
        queries: ZenohQueries | LcmQueries
        if isinstance(output, ZenohOutput):
            queries = ZenohQueries(output.settings.prefix, self._desks)
            output.when_open(queries.declare)
        elif isinstance(output, LcmOutput):
            drops = self._drops[output.name]
            queries = LcmQueries(output.settings, self._desks, drops, shared=output.is_shared)
            output.when_open(queries.declare)
        else:
            return
        self._queries[output.name] = queries
        for name, desk in self._desks.items():
            if desk.parameters_xml is not None:
                queries.tell_parameters(name, desk.parameters_xml)

    async def _close(self, output: Output) -> None:
        queries = self._queries.pop(output.name, None)
        if queries is not None:
            await queries.close()
        await asyncio.to_thread(output.close)

    def _tell_parameters(self, source: str, xml: bytes) -> None:
        for queries in self._queries.values():
            queries.tell_parameters(source, xml)

    def _tell_file(self, source: str, description: dict[str, Any]) -> None:
        for queries in self._queries.values():
            if isinstance(queries, ZenohQueries):
                queries.tell_file(source, description)


def _alike(one: Output, other: Output) -> bool:
    """Return whether both do the same; of a Zenoh configuration file what is in it counts."""
    if isinstance(one, ZenohOutput) and isinstance(other, ZenohOutput):
        return one.settings == other.settings and str(one.config) == str(other.config)
    return isinstance(one, LcmOutput) and isinstance(other, LcmOutput) and one.settings == other.settings


def _changes(what: str, gone: Collection[str], new: Collection[str]) -> list[str]:
    """Return what became of each: of those in ``gone``, in ``new`` or in both."""
    return [
        f"{what} {name} {'added' if name not in gone else 'changed' if name in new else 'removed'}"
        for name in dict.fromkeys((*gone, *new))
    ]


def _spool(settings: Settings) -> Spool:
    spool = settings.spool
    return Spool(spool.effective_directory, spool.max_files, spool.max_bytes)
