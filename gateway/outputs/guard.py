"""A wrapper around an output that may raise although the contract forbids it: nobody else must suffer."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from functools import partial
from logging import getLogger
from typing import Any, ParamSpec, TypeVar

from gateway.errors import OutputError
from gateway.logs.failures import DefectLog, defect_text
from gateway.logs.losses import Losses
from gateway.messages.topics import Topic
from gateway.outputs.contract import (
    Command,
    FramePublisher,
    Output,
    OutputHealth,
    Publisher,
    QueryService,
    ServerFile,
    ServerParameters,
)
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

logger = getLogger(__name__)


class GuardedOutput(Output):
    """An output of which no call raises, except ``publish`` of its publishers: routes count that as a loss.

    Each defect is logged, with its traceback the first time. A defect in a call that is not made again may
    leave a source without a topic, or peers without parameters. Then ``health`` names the defect, and the
    next reload opens the output again.
    """

    def __init__(self, output: Output) -> None:
        self.output = output
        """The output itself."""
        self.name = output.name
        self.max_rate_hz = output.max_rate_hz
        self.has_tool_poses = output.has_tool_poses
        self.drop_causes = output.drop_causes
        self._defects = DefectLog(logger, output.name)
        self._damage = ""

    def _try_once(
        self,
        call: Callable[_Parameters, _Result],
        otherwise: _Result,
        *args: _Parameters.args,
        **kwargs: _Parameters.kwargs,
    ) -> _Result:
        """Make a call that is not made again if it fails."""
        try:
            return call(*args, **kwargs)
        except Exception as defect:  # noqa: BLE001 - other outputs continue
            self._defects.log(defect)
            self._damage = self._damage or defect_text(defect)
            return otherwise

    # The core.

    def start(self) -> None:
        """See Output."""
        self._try_once(self.output.start, None)

    def publisher(self, topic: Topic) -> Publisher:
        """See Output. After a defect, the publisher accepts nothing, so that every message counts as lost."""
        publisher = self._try_once(self.output.publisher, _Refusal(topic.source), topic)
        return _GuardedPublisher(publisher, self._defects)

    def health(self) -> OutputHealth:
        """See Output. A defect is a problem of the output."""
        if self._damage:
            return OutputHealth(
                False, f"{self._damage}; reload the gateway to repair it, and report this with the log"
            )
        try:
            return self.output.health()
        except Exception as defect:  # noqa: BLE001 - other outputs continue
            self._defects.log(defect)
            return OutputHealth(False, f"{defect_text(defect)}; report this with the log")

    def close(self) -> None:
        """See Output."""
        self._try_once(self.output.close, None)

    # Maintenance.

    def maintain(self) -> None:
        """See Output."""
        self._defects.attempt(self.output.maintain, None)

    def is_configured_like(self, other: Output) -> bool:
        """See Output. One that a defect has damaged is like no other, so that a reload replaces it."""
        is_like = partial(self.output.is_configured_like, _inner(other))
        return not self._damage and self._defects.attempt(is_like, False)

    def take_over(self, other: Output) -> bool:
        """See Output."""
        differs = self._try_once(self.output.take_over, True, _inner(other))
        self.has_tool_poses = self.output.has_tool_poses
        return differs

    def count_losses(self, source: str, losses: Losses) -> None:
        """See Output."""
        self._try_once(self.output.count_losses, None, source, losses)

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """See Output. After a defect, everything is published."""
        return self._try_once(self.output.watch_wanted, False, source, on_change)

    # Liveliness.

    def announce(self, source: str) -> None:
        """See Output."""
        self._try_once(self.output.announce, None, source)

    def withdraw(self, source: str) -> None:
        """See Output."""
        self._try_once(self.output.withdraw, None, source)

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """See Output."""
        self._try_once(self.output.show_streaming, None, source, is_streaming)

    # Whole frames instead of components.

    def frame_publisher(self, source: str) -> FramePublisher | None:
        """See Output. After a defect, the publisher accepts nothing, so that every frame counts as lost."""
        publisher = self._try_once(self.output.frame_publisher, _Refusal(source), source)
        return None if publisher is None else _GuardedFramePublisher(publisher, self._defects)

    # Parameters and files from the server.

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """See Output."""
        return self._try_once(self.output.publish_parameters, None, source, parameters)

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """See Output."""
        return self._defects.attempt(partial(self.output.topic_names, source), {})

    def announce_file(self, source: str, file: ServerFile) -> None:
        """See Output."""
        self._try_once(self.output.announce_file, None, source, file)

    # Recordings and measurements of the server.

    def show_measurement(self, source: str, is_running: bool | None) -> None:
        """See Output."""
        self._try_once(self.output.show_measurement, None, source, is_running)

    async def follow_recording(self, source: str, *, start: bool, name: str) -> Mapping[str, Any]:
        """See Output. After a defect, the recording starts nevertheless."""
        try:
            return await self.output.follow_recording(source, start=start, name=name)
        except Exception as defect:  # noqa: BLE001 - other outputs continue
            self._defects.log(defect)
            return {}

    # Queries of peers.

    def serve_queries(self, service: QueryService) -> None:
        """See Output."""
        self._try_once(self.output.serve_queries, None, service)

    async def stop_queries(self) -> None:
        """See Output."""
        try:
            await self.output.stop_queries()
        except Exception as defect:  # noqa: BLE001 - the output is closed nevertheless
            self._defects.log(defect)

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """See Output."""
        return self._defects.attempt(lambda: self.output.query_results, None)

    @property
    def commands(self) -> Mapping[str, Command]:
        """See Output."""
        return self._defects.attempt(lambda: self.output.commands, {})


def _inner(output: Output) -> Output:
    return output.output if isinstance(output, GuardedOutput) else output


class _GuardedPublisher:
    """A publisher whose ``wanted`` and ``close`` do not raise. ``publish`` may, and costs nothing more."""

    def __init__(self, publisher: Publisher, defects: DefectLog) -> None:
        self.publish: Any = publisher.publish
        self._publisher = publisher
        self._defects = defects

    @property
    def wanted(self) -> bool:
        try:
            return self._publisher.wanted
        except Exception as defect:  # noqa: BLE001 - other outputs continue
            self._defects.log(defect)
            return True

    def close(self) -> None:
        self._defects.attempt(self._publisher.close, None)


class _GuardedFramePublisher:
    """A publisher of frames of which no method raises but ``publish``."""

    def __init__(self, publisher: FramePublisher, defects: DefectLog) -> None:
        self.publish: Any = publisher.publish
        self._publisher = publisher
        self._defects = defects

    def wants(self, components: Collection[ComponentType]) -> bool:
        return self._defects.attempt(partial(self._publisher.wants, components), True)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        return self._defects.attempt(partial(self._publisher.prepare, layout, components), True)

    def close(self) -> None:
        self._defects.attempt(self._publisher.close, None)


class _Refusal:
    """In place of a publisher that a defect prevented: every message or frame counts as lost."""

    wanted = True

    def __init__(self, source: str) -> None:
        self._source = source

    def wants(self, _components: Collection[ComponentType]) -> bool:
        return True

    def prepare(self, _layout: FrameLayout, _components: frozenset[ComponentType]) -> bool:
        return True

    def publish(self, *_: object) -> None:
        raise OutputError(
            f"{self._source} is not published here after a defect; see the ERROR in the log", cause="defect"
        )

    def close(self) -> None:
        pass
