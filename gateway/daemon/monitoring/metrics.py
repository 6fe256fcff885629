"""Prometheus metrics, read from the gateway's counters at each scrape.

The data path does not know about them. Label values come from the configuration and from this program
(sources, streams, components, outputs, causes, states), never from a network, so the number of series is
bounded.
"""

import contextlib
import platform
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from http import HTTPStatus
from importlib.metadata import version
from pathlib import Path
from typing import Final

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from gateway import __version__
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.http_pages import Page
from gateway.daemon.monitoring.process_limits import DiskFacts, LoopDelay
from gateway.messages.host_time import host_clock
from gateway.outputs.contract import WHOLE_FRAME, OutputStatus
from gateway.runtime.failures import defect_total
from gateway.runtime.losses import Loss
from gateway.session.clock import ServerClock
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus

METRIC_PREFIX: Final = "rtc3d_gateway_"

_HELP: Final = {
    "frames_received": "Frames received from the server.",
    "received_bytes": "Bytes received from the server.",
    "sessions": "Connections established with the server.",
    "reconnects": "Connection attempts after the first.",
    "server_restarts": "Times that frame numbers or time stamps started over within a connection.",
    "last_frame_timestamp_seconds": (
        "Arrival time of the newest frame since the Unix epoch; absent before the first frame."
    ),
    "lag_seconds": "How much later than the minimum delay the newest frame arrived.",
    "clock_valid": (
        "1 if the server's time stamps form a valid clock, else 0; the other clock metrics are then absent."
    ),
    "clock_offset_seconds": "Host time minus server time.",
    "clock_drift_ratio": "How much faster the host's clock runs than the server's; 1e-6 is 1 ppm.",
    "clock_uncertainty_seconds": (
        "Possible error of the clock, not counting the minimum network delay; +Inf at first."
    ),
    "stream_state": "1 for the stream's current state, 0 for the others.",
    "stream_drops": "Frames that lost a message before any output, and C3D files not stored, by cause.",
    "stream_dropped_messages": (
        "Messages of these frames that were lost, and C3D files not stored, by cause."
    ),
    "component_frames": "Frames with the component that have arrived, published or not.",
    "source_subscribed": (
        "1 if somebody may subscribe to the source's data, else 0; always 1 with LCM, which cannot know."
    ),
    "history_bytes": "Memory for the newest messages, which subscribers can ask for.",
    "history_messages": "Messages of the history that peers have asked for and got.",
    "messages": "Messages passed to the output; 6d/tool, status and clock count as separate components.",
    "message_bytes": "Bytes of these messages, without the overhead of Zenoh, LCM and the network.",
    "output_drops": "Messages that the output did not accept, and queries that it did not answer, by cause.",
    "output_dropped_frames": "Frames that lost at least one message on the output, by cause.",
    "output_connected": "1 if the output can send, else 0.",
    "queries": "Queries by result: ok, or the code of the error in the reply.",
    "certificate_not_after_timestamp_seconds": (
        "When a TLS certificate ends, since the Unix epoch; of several in one file, the first to end."
    ),
    "takes_free_bytes": "Room on the disk of the takes; absent while the output takes is off.",
    "loop_delay_seconds": "How late the event loop ran the last measured callback; frames wait just as long.",
    "loop_delay_max_seconds": "Largest of these delays in the last one to two minutes.",
    "host_clock_steps": (
        "How often the wall clock of this computer was set by 1 ms or more since the gateway started."
    ),
    "defects": "Defects of the gateway, repeats included; the log has each with its traceback.",
}
"""The help texts of the metrics, in the order of the page."""

# Counters of these causes exist from the start, so that PromQL sees the first drop as an increase.
_STREAM_DROP_CAUSES: Final = (
    *("frame rejected", "unknown component", "skipped while behind", "not sent by the server", "C3D file"),
)

_STATM: Final = Path("/proc/self/statm")

Labels = tuple[str, ...]
Sample = tuple[Labels, float]
"""The label values of a sample, and its value."""

_OfStream = Callable[[StreamStatus], float | None]
"""Returns the value of a metric with one sample per stream; None if a stream has none now."""


def _if_valid(value: Callable[[ServerClock], float]) -> _OfStream:
    """Return a function that returns a value of a stream's clock, or None while the clock is not valid."""
    return lambda status: value(status.clock) if status.clock.has_clock else None


_STREAM_COUNTERS: Final[Mapping[str, _OfStream]] = {
    "frames_received": lambda status: status.frames_in,
    "received_bytes": lambda status: status.bytes_in,
    "sessions": lambda status: status.connections,
    "reconnects": lambda status: status.reconnects,
    "server_restarts": lambda status: status.restarts,
}
_STREAM_GAUGES: Final[Mapping[str, _OfStream]] = {
    "last_frame_timestamp_seconds": lambda status: status.last_frame_utime / 1e6 or None,
    "lag_seconds": lambda status: status.lag_s,
    "clock_valid": lambda status: status.clock.has_clock,
    "clock_offset_seconds": _if_valid(lambda clock: (clock.offset_us + host_clock.offset_us) / 1e6),
    "clock_drift_ratio": _if_valid(lambda clock: clock.drift_ppm / 1e6),
    "clock_uncertainty_seconds": _if_valid(lambda clock: clock.uncertainty_us / 1e6),
}
_ROUTE_COUNTERS: Final[Mapping[str, Callable[[OutputStatus], Mapping[str, int]]]] = {
    "messages": lambda status: status.messages,
    "message_bytes": lambda status: status.message_bytes,
}
"""The counters of a source's messages to one output, by component."""

_OfLoss = Callable[[Loss], int]
_STREAM_LOSSES: Final[Mapping[str, _OfLoss]] = {
    "stream_drops": lambda loss: loss.frames or loss.messages,
    "stream_dropped_messages": lambda loss: loss.messages,
}
_OUTPUT_LOSSES: Final[Mapping[str, _OfLoss]] = {
    "output_drops": lambda loss: loss.messages,
    "output_dropped_frames": lambda loss: loss.frames,
}


class GatewayMetrics(Collector):
    """Reads a gateway's counters. It must be used in the thread of the event loop."""

    def __init__(self, gateway: Gateway, loop_delay: LoopDelay, disk_facts: DiskFacts) -> None:
        self._gateway = gateway
        self._disk_facts = disk_facts
        self._loop_delay = loop_delay
        self._build = {"version": __version__, "python": platform.python_version()}
        self._build |= {"zenoh": version("eclipse-zenoh"), "lcm": version("lcm")}

    def page(self) -> Page:
        """Return the page /metrics in Prometheus' text format."""
        return Page(HTTPStatus.OK, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(self))

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with its current samples."""
        yield from self._streams()
        yield from self._sources()
        yield from self._outputs()
        yield from self._process()

    def _streams(self) -> Iterator[Metric]:
        sources = self._gateway.sources
        streams = [((each.name, status.components), status) for each in sources for status in each.statuses]
        labels = ("source", "stream")
        for family, metrics in ((_counter, _STREAM_COUNTERS), (_gauge, _STREAM_GAUGES)):
            for name, value in metrics.items():
                found = ((stream, value(status)) for stream, status in streams)
                yield family(
                    name, labels, ((stream, number) for stream, number in found if number is not None)
                )
        states = [
            ((*stream, state.value), state is status.state)
            for stream, status in streams
            for state in StreamState
        ]
        yield _gauge("stream_state", (*labels, "state"), states)
        losses = [(stream, status.losses.report(), _STREAM_DROP_CAUSES) for stream, status in streams]
        yield from _loss_counters(_STREAM_LOSSES, labels, losses)

    def _sources(self) -> Iterator[Metric]:
        """Yield the metrics of each source, and of what it passes to each output."""
        sources = self._gateway.sources
        frames = [
            ((source.name, component.key), count)
            for source in sources
            for component, count in source.fan_out.frames.items()
            if component in source.queries.components
        ]
        yield _counter("component_frames", ("source", "component"), frames)
        subscribed = [
            ((source.name,), source.fan_out.has_subscribers(source.queries.components)) for source in sources
        ]
        yield _gauge("source_subscribed", ("source",), subscribed)
        kept = [((source.name,), source.fan_out.history.num_bytes) for source in sources]
        yield _gauge("history_bytes", ("source",), kept)
        labels = ("source", "output")
        found = [
            ((source.name, output.name), source.queries.num_found[output.name])
            for source in sources
            for output in self._gateway.outputs
            if output.query_results is not None
        ]
        yield _counter("history_messages", labels, found)
        routes = [
            ((source.name, output.name), source, output, status)
            for source in sources
            for output, status in source.fan_out.outputs
        ]
        for name, counts in _ROUTE_COUNTERS.items():
            samples: list[Sample] = []
            for route, source, _, status in routes:
                components = [component.key for component in source.queries.components]
                known = [WHOLE_FRAME] if status.takes_frames else components
                samples += _samples(route, counts(status), known)
            yield _counter(name, (*labels, "component"), samples)
        losses = [(route, status.losses, output.drop_causes) for route, _, output, status in routes]
        yield from _loss_counters(_OUTPUT_LOSSES, labels, losses)

    def _outputs(self) -> Iterator[Metric]:
        outputs, facts = self._gateway.outputs, self._disk_facts
        connected = [((output.name,), output.health().connected) for output in outputs]
        yield _gauge("output_connected", ("output",), connected)
        queries: list[Sample] = []
        for output in outputs:
            results = output.query_results
            if results is not None:
                total = sum(map(Counter, results.values()), Counter())
                queries += _samples((output.name,), total, ("ok",))
        yield _counter("queries", ("output", "result"), queries)
        ends_s = facts.certificate_ends_s.items()
        yield _gauge("certificate_not_after_timestamp_seconds", ("output", "key"), ends_s)
        free_bytes = facts.takes_free_bytes
        yield _gauge("takes_free_bytes", (), [] if free_bytes is None else [((), free_bytes)])

    def _process(self) -> Iterator[Metric]:
        yield _gauge("loop_delay_seconds", (), [((), self._loop_delay.last_s)])
        yield _gauge("loop_delay_max_seconds", (), [((), self._loop_delay.max_s)])
        yield _counter("host_clock_steps", (), [((), host_clock.steps)])
        yield _counter("defects", (), [((), defect_total.count)])
        yield InfoMetricFamily(f"{METRIC_PREFIX}build", "Versions; always 1.", self._build)
        # prometheus_client's own collector reads /proc/stat, which the service's sandbox hides.
        cpu_s = time.process_time()
        yield CounterMetricFamily("process_cpu_seconds", "CPU time of the gateway.", cpu_s)
        with contextlib.suppress(OSError):  # no file can be opened, which the health says
            memory_bytes = int(_STATM.read_text().split()[1]) * resource.getpagesize()
            yield GaugeMetricFamily(
                "process_resident_memory_bytes", "Resident memory of the gateway.", memory_bytes
            )


def _loss_counters(
    counters: Mapping[str, _OfLoss],
    labels: Labels,
    losses: Sequence[tuple[Labels, Sequence[Loss], Iterable[str]]],
) -> Iterator[Metric]:
    """Yield the counters of lost messages and frames by cause, of each stream or of each output.

    ``losses`` are label values, what was lost, and the causes that are shown from the start.
    """
    for name, count in counters.items():
        samples: list[Sample] = []
        for values, lost, known in losses:
            samples += _samples(values, {loss.cause: count(loss) for loss in lost}, known)
        yield _counter(name, (*labels, "cause"), samples)


def _samples(labels: Labels, counts: Mapping[str, int], known: Iterable[str]) -> Iterator[Sample]:
    """Yield one sample per count, and a 0 for each of the ``known`` names without a count."""
    for name, count in (dict.fromkeys(known, 0) | dict(counts)).items():
        yield (*labels, name), count


def _counter(name: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _with_samples(CounterMetricFamily(METRIC_PREFIX + name, _HELP[name], labels=labels), samples)


def _gauge(name: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _with_samples(GaugeMetricFamily(METRIC_PREFIX + name, _HELP[name], labels=labels), samples)


def _with_samples(family: CounterMetricFamily | GaugeMetricFamily, samples: Iterable[Sample]) -> Metric:
    for labels, value in samples:
        family.add_metric(labels, value)
    return family
