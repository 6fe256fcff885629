"""``echo --complete``: print messages in order, with those that were lost on the way from the history."""

import contextlib
import math
import queue
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, TextIO

from typing_extensions import override

from gateway.client.reception import MAX_SERIES, Reception
from gateway.client.refill import END_S, Refill
from gateway.client.sources import POSE, ReceivedSeries, ReceivedSource
from gateway.client.transport import GatewaySubscriber, close_in_time
from gateway.messages.decode import decode
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import MAX_SOURCES, escape_key_chunk, lcm_channel
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.runtime.safe_text import safe_text
from gateway.tools.cli.echo_output import MAX_WAITING, json_line, text_line, too_fast_text
from gateway.tools.cli.echo_sources import EchoSources
from gateway.tools.cli.record_output import missing_texts, unknown_texts

_POLL_S: Final = 0.1

_MAX_NOTES: Final = 10


class CompleteMessages(Reception[ReceivedSource, ReceivedSeries]):
    """Messages that wait to be printed, each with its key or channel. ``name_of`` returns that of a series.

    When MAX_WAITING messages wait, those that arrive are let go and requested later, when there is room. What
    the gateway's history cannot repeat is left out then, and counted. Of all series that it can complete,
    more may wait: what was held until a gap was filled, which is bounded by MAX_HELD_BYTES.
    """

    def __init__(self, component: str | None, prefix: str | None, *, is_lcm: bool) -> None:
        super().__init__()
        self.waiting: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self.num_dropped = 0
        """How many messages were left out, because too many waited."""
        self._is_lcm = is_lcm
        self._prefix = prefix or DEFAULT_ZENOH_PREFIX
        self._wanted = None if component is None else _key_of(component, is_lcm=is_lcm)
        self.is_ending = False
        """Whether nothing more is taken of what is published."""

    @property
    @override
    def has_room(self) -> bool:
        return self.waiting.qsize() < MAX_WAITING // 2

    @property
    @override
    def is_full(self) -> bool:
        return self.waiting.qsize() >= MAX_WAITING

    def end(self, refill: Refill) -> None:
        """Take nothing more that is published, and request what is missing until now."""
        self.is_ending = True
        refill.end()

    def wants(self, series: ReceivedSeries) -> bool:
        """Return whether the messages of a series are printed."""
        return self._wanted in {None, series.key, series.row}

    def _completes(self, series: ReceivedSeries) -> bool:
        return self.wants(series) and not self.is_ending and super()._completes(series)

    def _new_source(self, name: str, channels: str) -> ReceivedSource:
        return ReceivedSource(name, channels, self.monotonic)

    def _new_series(self, source: ReceivedSource, key: str, channel: str) -> ReceivedSeries:
        return ReceivedSeries(source, key, channel)

    def _take(self, series: ReceivedSeries, message: bytes) -> None:
        if self.wants(series):
            self._put(series, message)

    def _take_parameters(
        self,
        series: ReceivedSeries,
        message: bytes,
        *,
        is_first: bool,  # noqa: ARG002 - it overrides
        is_made: bool,
    ) -> None:
        if self.wants(series):
            self._put(series, xml_bytes(decode(message).xml) if is_made else message)

    def _put(self, series: ReceivedSeries, message: bytes) -> None:
        completion = series.completion
        if completion is None or completion.problem:
            if self.is_ending:
                return
            if self.is_full:
                self.num_dropped += 1
                return
        name = (
            series.channel.decode() if self._is_lcm else f"{self._prefix}/{series.source.name}/{series.key}"
        )
        self.waiting.put((name, message))


def _key_of(component: str, *, is_lcm: bool) -> str:
    """Return the key or the row of the series that --component names; channels do not say labels exactly."""
    label = component.removeprefix(POSE)
    if label in {component, "*"}:
        return component
    part = lcm_channel("", "6d", label).removeprefix("_6D_") if is_lcm else escape_key_chunk(label)
    return f"{POSE}{part}"


def print_complete(
    subscribe: Callable[[CompleteMessages], GatewaySubscriber],
    messages: CompleteMessages,
    sources: EchoSources,
    out: TextIO,
    *,
    count: int | None,
    seconds: float | None,
    as_json: bool,
) -> tuple[int, bool]:
    """Print messages as ``print_messages`` does, but in order and with what was missed.

    Everything that is published within ``seconds`` is printed, even if that takes longer. Return how many
    messages were printed, and whether none is missing; stderr says which are. Raises OutputError, QueryError.
    """
    line = json_line if as_json else partial(text_line, units_of=sources.units_of)
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    num_printed = 0
    with subscribed(subscribe, messages) as refill:
        while count is None or num_printed < count:
            now_s = time.monotonic()
            if now_s >= end_s:
                if messages.is_ending:  # nothing has come for a while
                    refill.close()
                messages.end(refill)
                end_s = now_s + END_S
            is_all_here = messages.is_ending and not refill.num_incomplete
            try:
                received = messages.waiting.get(timeout=_POLL_S)
            except queue.Empty:
                if is_all_here:
                    break
                if not num_printed:
                    sources.check_silence()
                continue
            print(line(*received), file=out, flush=True)
            num_printed += 1
            if messages.is_ending:
                end_s = time.monotonic() + END_S
        has_all = not any(_problems(messages))
    return num_printed, has_all


@contextlib.contextmanager
def subscribed(
    subscribe: Callable[[CompleteMessages], GatewaySubscriber], messages: CompleteMessages
) -> Iterator[Refill]:
    """Subscribe until the end of the block, and say then what was fetched and what is missing."""
    subscriber = subscribe(messages)
    assert messages.refill is not None  # noqa: S101 - it is wanted
    try:
        yield messages.refill
    finally:
        # Before closing: what is still to be fetched then is not printed, but not lost either.
        for text in _report(messages):
            print(safe_text(text), file=sys.stderr)
        close_in_time(subscriber)


def _report(messages: CompleteMessages) -> Iterator[str]:
    """Yield what was fetched and what is missing; nothing if no message has arrived."""
    wanted = [series for series in messages.all_series if messages.wants(series)]
    problems = [*_problems(messages)]
    if any(series.num_messages for series in wanted):
        num_refilled = sum(each.completion.num_refilled for each in wanted if each.completion is not None)
        end = "INCOMPLETE" if problems else "no gaps"
        yield f"{num_refilled} messages came from the gateway's history: {end}"
    yield from problems
    reasons = {(each.source.name, each.completion.last_problem) for each in wanted if each.completion}
    for source, problem in sorted(reasons)[:_MAX_NOTES]:
        if problem:
            yield f"{source}: gaps are not filled: {problem}"
    if messages.num_foreign:
        yield (
            f"{messages.num_foreign} messages were not printed: they are none of this version's types; "
            "echo without --complete prints them"
        )


def _problems(messages: CompleteMessages) -> Iterator[str]:
    wanted = [series for series in messages.all_series if messages.wants(series)]
    yield from missing_texts(wanted)
    yield from unknown_texts(wanted)
    if messages.num_dropped:
        yield too_fast_text(messages.num_dropped)
    if messages.num_beyond:
        yield (
            f"{messages.num_beyond} messages were not printed: there are more than {MAX_SOURCES} sources or "
            f"{MAX_SERIES} keys; choose some with --source and --component"
        )
    if messages.defect is not None:
        yield (
            f"{messages.num_defects} messages were not printed because of a defect in rtc3d-gateway: "
            f"{type(messages.defect).__name__}: {messages.defect}; report this"
        )
