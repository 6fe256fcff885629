"""The gateway as a whole: builds, connects, runs, reloads and stops sources and outputs."""

import asyncio
import logging
from collections.abc import Collection, Mapping, Sequence
from typing import Final

from gateway.config.settings import Settings, SourceSettings, SpoolSettings
from gateway.daemon.source import Source, SourceHistory
from gateway.messages.host_time import host_clock
from gateway.outputs.contract import Answer, Command, Output
from gateway.outputs.guard import GuardedOutput
from gateway.outputs.registry import build_outputs
from gateway.publish.routes import OPENING_S
from gateway.queries.answers import FRAME_KEY, frame_answer
from gateway.queries.service import SourceQueries, SourceQueryService
from gateway.runtime.failures import defect_text, log_fields
from gateway.runtime.workers import WorkerThread
from gateway.session.c3d_files.spool import Spool
from gateway.session.supervisor import Backoff

_STATUS_PERIOD_S: Final = 1.0
_OPENING_POLL_S: Final = 0.02

logger = logging.getLogger(__name__)


class Gateway:
    """All sources and all outputs of one configuration. Create it in a running event loop.

    If ``outputs`` are given (by the demo or a test), a reload keeps them; otherwise they are built from the
    settings.
    """

    def __init__(self, settings: Settings, outputs: Sequence[Output] | None = None) -> None:
        self.settings = settings
        self._given_outputs = None if outputs is None else [GuardedOutput(output) for output in outputs]
        self.outputs = self._build_outputs(settings)
        """The outputs. None of them raises anything."""
        self._spool = _new_spool(settings.spool)
        self._sources: dict[str, Source] = {}
        self._histories: dict[str, SourceHistory] = {}  # also of removed sources: a reload may add them again
        self._source_tasks: dict[str, asyncio.Task[None]] = {}
        self._tasks = asyncio.TaskGroup()
        self._reload_lock = asyncio.Lock()
        self.opened = asyncio.Event()
        """Set once the outputs are open, but at most 2 s after the start: one may be unavailable for long."""
        for output in self.outputs:
            self._serve_queries(output)
        for source in settings.sources:
            self._add_source(source)
        self._share_history()

    @property
    def sources(self) -> Sequence[Source]:
        """The sources."""
        return list(self._sources.values())

    def _serve_queries(self, output: GuardedOutput) -> None:
        def queries() -> Mapping[str, SourceQueries]:
            return {name: source.queries for name, source in self._sources.items()}

        output.serve_queries(SourceQueryService(queries, self._commands, output.name))

    def _commands(self) -> Mapping[str, Command]:
        of_outputs = {name: command for output in self.outputs for name, command in output.commands.items()}
        return {FRAME_KEY: self._answer_frame, **of_outputs}

    async def _answer_frame(self, source: str, options: Mapping[str, str]) -> Answer:
        names = {output.name: output.topic_names(source) for output in self.outputs}
        return frame_answer(self._sources[source].queries.frame, names, options)

    # Running.

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then send Bye to every server and close the outputs."""
        for output in self.outputs:
            output.start()
        self._spool.reader.submit(self._spool.delete_abandoned)
        try:
            deadline_s = asyncio.get_running_loop().time() + OPENING_S
            while not stop.is_set() and not all(output.health().connected for output in self.outputs):
                if asyncio.get_running_loop().time() >= deadline_s:
                    break
                await asyncio.sleep(_OPENING_POLL_S)
            async with self._tasks:
                for name in self._sources:
                    self._start_source(name)
                periodic = self._tasks.create_task(self._run_every_second())
                self.opened.set()
                await stop.wait()
                await self._reload_lock.acquire()  # wait for a running reload, and prevent another one
                logger.info("stopping")
                for task in (periodic, *self._source_tasks.values()):
                    task.cancel()
        finally:
            await _close_all(self.outputs)
            for source in self._sources.values():
                source.fan_out.end_losses()

    def _start_source(self, name: str) -> None:
        self._source_tasks[name] = self._tasks.create_task(self._run_source(name), name=f"source {name}")

    async def _run_source(self, name: str) -> None:
        """Run a source until cancelled.

        The rule for defects: what goes wrong in one connection ends that connection (see Supervisor.run).
        Whatever else goes wrong in handling a source arrives here. It is logged as an error, and the source
        is built again and run after a pause, which grows as long as the defect returns soon. Nobody else
        notices.
        """
        loop = asyncio.get_running_loop()
        with log_fields(source=name):
            backoff = Backoff(self._sources[name].settings.reconnect)
            while True:
                source = self._sources[name]
                began_s = loop.time()
                defect = await _run_to_defect(source)
                text = f"{defect_text(defect)}; the source is started again; report this with the log"
                source.history.defects.log(defect, text)
                pause_s = backoff.delay_after(loop.time() - began_s, had_data=True)
                try:
                    self._add_source(source.settings)
                    self._sources[name].show_restart(text)
                except Exception as defect:  # noqa: BLE001 - the former one fails at once, and this is repeated
                    source.history.defects.log(defect)
                await asyncio.sleep(pause_s)

    async def _run_every_second(self) -> None:
        """Maintain the outputs, and check each source and publish its status."""
        while True:
            await asyncio.sleep(_STATUS_PERIOD_S)
            host_clock.read()  # detects a step of the wall clock even if no frame arrives
            for output in self.outputs:
                output.maintain()
            for source in self._sources.values():
                try:
                    source.publish_status()
                except Exception as defect:  # noqa: BLE001 - the others continue
                    source.fail(defect)

    # Reloading.

    async def reload(self, settings: Settings) -> list[str]:
        """Apply ``settings`` and return a text for each change. Call it after ``opened`` is set.

        Sources and outputs with unchanged settings keep running. A source that differs sends Bye and connects
        again, unless only its frame of poses differs; an output that differs is closed and opened again,
        unless it can take over the new settings.
        Session and sequence numbers continue.
        Raises ConfigError, and changes nothing, if an output refuses its configuration. A defect in one
        source does not keep the others from changing; it is raised at the end. Each step compares what runs
        with what is wanted, so the next reload repeats what has failed.
        """
        async with self._reload_lock:
            built = self._build_outputs(settings)
            outputs = [
                next((running for running in self.outputs if running.is_configured_like(output)), output)
                for output in built
            ]
            kept = [pair for pair in zip(outputs, built, strict=True) if pair[0] is not pair[1]]
            changes = [f"output {output.name} changed" for output, like in kept if output.take_over(like)]
            changes += await self._change_outputs(outputs)
            if settings.spool != self.settings.spool:
                self._spool = _new_spool(settings.spool)
                for source in self._sources.values():
                    source.spool = self._spool
                changes.append("spool changed")
            changes += await self._change_sources(settings.sources)
            if settings.history != self.settings.history:
                changes.append("history changed")
            self.settings = settings
            self._share_history()
            return changes

    def _build_outputs(self, settings: Settings) -> list[GuardedOutput]:
        if self._given_outputs is not None:
            return list(self._given_outputs)
        return [GuardedOutput(output) for output in build_outputs(settings)]

    async def _change_outputs(self, outputs: list[GuardedOutput]) -> list[str]:
        removed = [output for output in self.outputs if output not in outputs]
        new = [output for output in outputs if output not in self.outputs]
        self.outputs = outputs
        for output in new:
            self._serve_queries(output)
        for source in self._sources.values():
            source.fan_out.set_outputs(outputs)
        await _close_all(removed)  # first, because a new output may use the same address
        for output in new:
            output.start()
            for name, source in self._sources.items():
                parameters = source.known_parameters
                if parameters.version:
                    output.publish_parameters(name, parameters)
                else:
                    source.fan_out.begin(parameters)
        return _changes("output", [output.name for output in removed], [output.name for output in new])

    async def _change_sources(self, wanted_sources: Sequence[SourceSettings]) -> list[str]:
        wanted = {settings.name: settings for settings in wanted_sources}
        changes = []
        for name, source in self._sources.items():
            like = wanted.get(name)
            if like is not None and like != source.settings and like.connects_like(source.settings):
                changes.append(f"coordinate frame of source {name} changed")
                try:
                    await source.change_frame(like)
                except Exception as defect:  # noqa: BLE001 - the source starts again with the new frame
                    source.fail(defect)
        stopped = [
            name
            for name, source in self._sources.items()
            if source.settings != wanted.get(name) or name not in self._source_tasks
        ]
        new = [name for name in wanted if name in stopped or name not in self._sources]
        await asyncio.gather(*map(self._stop_source, stopped))
        for name in stopped:
            if name not in wanted:
                self._sources.pop(name).fan_out.close()
        defects = []
        for name in new:
            try:
                self._add_source(wanted[name])
                self._start_source(name)
            except Exception as defect:  # noqa: BLE001 - raised below
                defects.append(defect)
        self._sources = {name: self._sources[name] for name in wanted if name in self._sources}
        if defects:
            raise defects[0]
        return changes + _changes("source", stopped, new)

    def _share_history(self) -> None:
        """Divide the memory for the newest messages among the sources. A removed one keeps none."""
        limits = self.settings.history
        for name, history in self._histories.items():
            max_bytes = limits.max_bytes // len(self._sources) if name in self._sources else 0
            history.fan_out.history.set_limits(limits.seconds, max_bytes)

    async def _stop_source(self, name: str) -> None:
        task = self._source_tasks.pop(name, None)
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    def _add_source(self, settings: SourceSettings) -> None:
        """Build a source, anew if there is or was one of this name."""
        history = self._histories.get(settings.name)
        if history is None:
            history = self._histories[settings.name] = SourceHistory(settings, self.outputs)
        elif settings.name not in self._sources:
            history.fan_out.set_outputs(self.outputs)
        self._sources[settings.name] = Source(settings, history, self._spool)


async def _run_to_defect(source: Source) -> BaseException:
    """Run a source until a defect ends it, and return that; raises CancelledError if cancelled."""
    # In a task of its own: in Python 3.11, the one that leaves a TaskGroup does not know who cancelled it.
    task = asyncio.create_task(source.run())
    try:
        await asyncio.wait([task])
    except asyncio.CancelledError:
        task.cancel()
        await asyncio.wait([task])
        if not task.cancelled() and (defect := task.exception()) is not None:
            source.history.defects.log(defect)
        raise
    end = None if task.cancelled() else task.exception()
    return end or RuntimeError("the source has ended, and nobody stopped it")


async def _close_all(outputs: Sequence[GuardedOutput]) -> None:
    async def close(output: GuardedOutput) -> None:
        await output.stop_queries()
        try:
            await WorkerThread(f"close {output.name}").run(output.close)
        except RuntimeError:  # there is no room for another thread
            output.close()

    await asyncio.gather(
        *(asyncio.create_task(close(output), name=f"output {output.name}") for output in outputs)
    )


def _changes(what: str, removed: Collection[str], new: Collection[str]) -> list[str]:
    """Return "WHAT NAME removed", "added" or, for names in both collections, "changed"."""
    return [
        f"{what} {name} {'added' if name not in removed else 'changed' if name in new else 'removed'}"
        for name in dict.fromkeys((*removed, *new))
    ]


def _new_spool(settings: SpoolSettings) -> Spool:
    return Spool(settings.effective_directory, settings.max_files, settings.max_bytes)
