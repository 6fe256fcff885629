"""A wrapper around an output that may raise although the contract forbids it: nobody else must suffer."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from logging import getLogger
from typing import Any, Concatenate, ParamSpec, TypeVar

from typing_extensions import override

from gateway.errors import OutputError, QueryError, raise_unless_defect
from gateway.messages.history import FoundMessages, WantedMessages
from gateway.messages.topics import Topic
from gateway.outputs.contract import Command, FramePublisher, Output, OutputHealth, Publisher
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout
from gateway.runtime.failures import DefectLog, defect_text

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

logger = getLogger(__name__)


def _guarded(
    method: Callable[Concatenate[Output, _Parameters], _Result],
    otherwise: _Result,
    *,
    is_repeated: bool = False,
) -> Callable[Concatenate["GuardedOutput", _Parameters], _Result]:
    """Return ``method`` of Output for a GuardedOutput: a call that returns ``otherwise`` after a defect.

    If ``is_repeated``, the gateway makes the call again and again, so a defect does not damage the output.
    """
    name = method.__name__

    def call(self: "GuardedOutput", /, *args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        inner: Callable[_Parameters, _Result] = getattr(self.output, name)
        if is_repeated:
            return self.defects.attempt(partial(inner, *args, **kwargs), otherwise)
        return self.try_once(inner, otherwise, *args, **kwargs)

    return call


class GuardedOutput(Output):
    """An output of which no call raises, except ``publish`` of its publishers: routes count that as a loss.

    Each defect is logged, with its traceback the first time. A defect in a call that is not made again may
    leave a source without a topic, or peers without parameters. Then ``health`` names the defect, and the
    next reload opens the output again.
    """

    def __init__(self, output: Output) -> None:
        self.output = output
        """The output itself."""
        self.defects = DefectLog(logger, output.name)
        self.name = output.name
        self.max_rate_hz = output.max_rate_hz
        self.has_tool_poses = output.has_tool_poses
        self.drop_causes = output.drop_causes
        self._damage = ""

    def try_once(
        self,
        call: Callable[_Parameters, _Result],
        otherwise: _Result,
        *args: _Parameters.args,
        **kwargs: _Parameters.kwargs,
    ) -> _Result:
        """Make a call that is not made again if it fails."""
        try:
            return call(*args, **kwargs)
        except BaseException as defect:  # noqa: BLE001 - other outputs continue
            raise_unless_defect(defect)
            self.defects.log(defect)
            self._damage = self._damage or defect_text(defect)
            return otherwise

    start = _guarded(Output.start, None)
    close = _guarded(Output.close, None)
    count_losses = _guarded(Output.count_losses, None)
    watch_wanted = _guarded(Output.watch_wanted, otherwise=False)  # then everything is published
    announce = _guarded(Output.announce, None)
    withdraw = _guarded(Output.withdraw, None)
    show_streaming = _guarded(Output.show_streaming, None)
    show_measurement = _guarded(Output.show_measurement, None)
    publish_parameters = _guarded(Output.publish_parameters, None)
    announce_file = _guarded(Output.announce_file, None)
    serve_queries = _guarded(Output.serve_queries, None)
    maintain = _guarded(Output.maintain, None, is_repeated=True)
    warnings = _guarded(Output.warnings, (), is_repeated=True)
    topic_names = _guarded(Output.topic_names, {}, is_repeated=True)
    oldest_recorded = _guarded(Output.oldest_recorded, None, is_repeated=True)

    @override
    def publisher(self, topic: Topic) -> Publisher:
        """After a defect, the publisher accepts nothing, so that every message counts as lost."""
        return _GuardedPublisher(
            self.try_once(self.output.publisher, _Refusal(topic.source), topic), self.defects
        )

    @override
    def frame_publisher(self, source: str) -> FramePublisher | None:
        """After a defect, the publisher accepts nothing, so that every frame counts as lost."""
        publisher = self.try_once(self.output.frame_publisher, _Refusal(source), source)
        return None if publisher is None else _GuardedPublisher(publisher, self.defects)

    @override
    def take_over(self, other: Output) -> bool:
        differs = self.try_once(self.output.take_over, True, _inner(other))
        self.has_tool_poses = self.output.has_tool_poses
        return differs

    @override
    def health(self) -> OutputHealth:
        """A defect is a problem of the output."""
        if self._damage:
            return OutputHealth(
                False, f"{self._damage}; reload the gateway to repair it, and report this with the log"
            )
        try:
            return self.output.health()
        except BaseException as defect:  # noqa: BLE001 - other outputs continue
            raise_unless_defect(defect)
            self.defects.log(defect)
            return OutputHealth(False, f"{defect_text(defect)}; report this with the log")

    @override
    def is_configured_like(self, other: Output) -> bool:
        """One that a defect has damaged is like no other, so that a reload replaces it."""
        is_like = partial(self.output.is_configured_like, _inner(other))
        return not self._damage and self.defects.attempt(is_like, False)

    @override
    async def follow_recording(self, source: str, *, start: bool, name: str) -> Mapping[str, Any]:
        """After a defect, the recording starts nevertheless."""
        try:
            return await self.output.follow_recording(source, start=start, name=name)
        except BaseException as defect:  # noqa: BLE001 - other outputs continue
            raise_unless_defect(defect)
            self.defects.log(defect)
            return {}

    @override
    async def recorded_messages(self, source: str, key: str, wanted: WantedMessages) -> FoundMessages | None:
        try:
            return await self.output.recorded_messages(source, key, wanted)
        except QueryError:
            raise
        except BaseException as defect:  # noqa: BLE001 - there are the messages in memory
            raise_unless_defect(defect)
            self.defects.log(defect)
            return None

    @override
    async def stop_queries(self) -> None:
        try:
            await self.output.stop_queries()
        except BaseException as defect:  # noqa: BLE001 - the output is closed nevertheless
            raise_unless_defect(defect)
            self.defects.log(defect)

    @property
    @override
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        return self.defects.attempt(lambda: self.output.query_results, None)

    @property
    @override
    def commands(self) -> Mapping[str, Command]:
        return self.defects.attempt(lambda: self.output.commands, {})


def _inner(output: Output) -> Output:
    return output.output if isinstance(output, GuardedOutput) else output


class _GuardedPublisher:
    """A publisher of which no method raises but ``publish``, which costs nothing more."""

    def __init__(self, publisher: Any, defects: DefectLog) -> None:
        self.publish: Any = publisher.publish
        self._publisher = publisher
        self._defects = defects

    @property
    def wanted(self) -> bool:
        try:
            return bool(self._publisher.wanted)
        except BaseException as defect:  # noqa: BLE001 - other outputs continue
            raise_unless_defect(defect)
            self._defects.log(defect)
            return True

    def wants(self, components: Collection[ComponentType]) -> bool:
        return self._defects.attempt(lambda: bool(self._publisher.wants(components)), True)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        return self._defects.attempt(lambda: bool(self._publisher.prepare(layout, components)), True)

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
