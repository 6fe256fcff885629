"""Prometheus metrics, read from the gateway's counters at each scrape.

The data path does not know about them. Label values come from the configuration and from this program
(sources, streams, components, outputs, causes, states), never from a network, so the number of series is
bounded.
"""

import platform
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from http import HTTPStatus
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from gateway import __version__
from gateway.logs.failures import defect_total
from gateway.logs.losses import Loss
from gateway.messages.host_time import host_clock
from gateway.outputs.contract import WHOLE_FRAME, OutputStatus
from gateway.service.gateway import Gateway
from gateway.service.monitoring.disk_facts import DiskFacts
from gateway.service.monitoring.http_pages import Page
from gateway.service.monitoring.process_limits import LoopDelay
from gateway.stream.clock import ServerClock
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus

METRIC_PREFIX: Final = "rtc3d_gateway_"

# Counters of these causes exist from the start, so that PromQL sees the first drop as an increase.
_STREAM_DROP_CAUSES: Final = (
    "frame rejected",
    "unknown component",
    "skipped while behind",
    "not sent by the server",
    "C3D file",
)

Labels = tuple[str, ...]
Sample = tuple[Labels, float]
"""The label values of a sample, and its value."""


class _StreamMetric(NamedTuple):
    """A metric with one sample per stream; ``value`` returns None if a stream has none now."""

    name: str
    help_text: str
    value: Callable[[StreamStatus], float | None]


def _if_valid(value: Callable[[ServerClock], float]) -> Callable[[StreamStatus], float | None]:
    """Return a function that returns a value of a stream's clock, or None while the clock is not valid."""
    return lambda status: value(status.clock) if status.clock.has_clock else None


_STREAM_COUNTERS: Final = (
    _StreamMetric("frames_received", "Frames received from the server.", lambda status: status.frames_in),
    _StreamMetric("received_bytes", "Bytes received from the server.", lambda status: status.bytes_in),
    _StreamMetric("sessions", "Connections established with the server.", lambda status: status.connections),
    _StreamMetric("reconnects", "Connection attempts after the first.", lambda status: status.reconnects),
    _StreamMetric(
        "server_restarts",
        "Times that frame numbers or time stamps started over within a connection.",
        lambda status: status.restarts,
    ),
)
_STREAM_GAUGES: Final = (
    _StreamMetric(
        "last_frame_timestamp_seconds",
        "Arrival time of the newest frame since the Unix epoch; absent before the first frame.",
        lambda status: status.last_frame_utime / 1e6 if status.last_frame_utime else None,
    ),
    _StreamMetric(
        "lag_seconds",
        "How much later than the minimum delay the newest frame arrived.",
        lambda status: status.lag_s,
    ),
    _StreamMetric(
        "clock_valid",
        "1 if the server's time stamps form a valid clock, else 0; the other clock metrics are then absent.",
        lambda status: status.clock.has_clock,
    ),
    _StreamMetric(
        "clock_offset_seconds",
        "Host time minus server time.",
        _if_valid(lambda clock: (clock.offset_us + host_clock.offset_us) / 1e6),
    ),
    _StreamMetric(
        "clock_drift_ratio",
        "How much faster the host's clock runs than the server's; 1e-6 is 1 ppm.",
        _if_valid(lambda clock: clock.drift_ppm / 1e6),
    ),
    _StreamMetric(
        "clock_uncertainty_seconds",
        "Possible error of the clock, not counting the minimum network delay; +Inf at first.",
        _if_valid(lambda clock: clock.uncertainty_us / 1e6),
    ),
)

_ROUTE_COUNTERS: Final[tuple[tuple[str, str, Callable[[OutputStatus], Mapping[str, int]]], ...]] = (
    (
        "messages",
        "Messages passed to the output; 6d/tool, status and clock count as separate components.",
        lambda status: status.messages,
    ),
    (
        "message_bytes",
        "Bytes of these messages, without the overhead of Zenoh, LCM and the network.",
        lambda status: status.message_bytes,
    ),
)
"""Name, help text and value of the counters of a source's messages to one output."""


_LOSS_COUNTERS: Final[Mapping[str, Sequence[tuple[str, str, Callable[[Loss], int]]]]] = {
    "stream": (
        (
            "stream_drops",
            "Frames that lost a message before any output, and C3D files not stored, by cause.",
            lambda loss: loss.frames or loss.messages,
        ),
        (
            "stream_dropped_messages",
            "Messages of these frames that were lost, and C3D files not stored, by cause.",
            lambda loss: loss.messages,
        ),
    ),
    "output": (
        (
            "output_drops",
            "Messages that the output did not accept, and queries that it did not answer, by cause.",
            lambda loss: loss.messages,
        ),
        (
            "output_dropped_frames",
            "Frames that lost at least one message on the output, by cause.",
            lambda loss: loss.frames,
        ),
    ),
}
"""Name, help text and value of the counters of what is lost."""


def metrics_registry(gateway: Gateway, loop_delay: LoopDelay, disk_facts: DiskFacts) -> CollectorRegistry:
    """Return the registry of all metrics of ``gateway``."""
    registry = CollectorRegistry()
    registry.register(GatewayCollector(gateway, loop_delay, disk_facts))
    return registry


def metrics_page(registry: CollectorRegistry) -> Page:
    """Return the page /metrics in Prometheus' text format."""
    return Page(HTTPStatus.OK, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(registry))


class GatewayCollector(Collector):
    """Reads a gateway's counters. ``collect`` must run in the thread of the event loop."""

    def __init__(self, gateway: Gateway, loop_delay: LoopDelay, disk_facts: DiskFacts) -> None:
        self._gateway = gateway
        self._disk_facts = disk_facts
        self._loop_delay = loop_delay
        self._build = {
            "version": __version__,
            "python": platform.python_version(),
            "zenoh": version("eclipse-zenoh"),
            "lcm": version("lcm"),
        }

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with its current samples."""
        yield from self._streams()
        yield self._component_frames()
        yield _gauge(
            "source_subscribed",
            "1 if somebody may subscribe to the source's data, else 0; always 1 with LCM, which cannot know.",
            ("source",),
            [
                ((source.name,), source.fan_out.has_subscribers(source.queries.components))
                for source in self._gateway.sources
            ],
        )
        yield from self._routes()
        yield from self._outputs()
        yield from self._disks()
        yield from self._process()

    def _streams(self) -> Iterator[Metric]:
        streams = [
            ((source.name, status.components), status)
            for source in self._gateway.sources
            for status in source.statuses
        ]
        labels = ("source", "stream")
        for family, metrics in ((_counter, _STREAM_COUNTERS), (_gauge, _STREAM_GAUGES)):
            for name, help_text, value in metrics:
                samples = [
                    (stream, number) for stream, status in streams if (number := value(status)) is not None
                ]
                yield family(name, help_text, labels, samples)
        yield _gauge(
            "stream_state",
            "1 for the stream's current state, 0 for the others.",
            (*labels, "state"),
            [
                ((*stream, state.value), state is status.state)
                for stream, status in streams
                for state in StreamState
            ],
        )
        yield from _loss_counters(
            "stream",
            labels,
            [(stream, status.losses.report(), _STREAM_DROP_CAUSES) for stream, status in streams],
        )

    def _component_frames(self) -> Metric:
        return _counter(
            "component_frames",
            "Frames with the component that have arrived, published or not.",
            ("source", "component"),
            [
                ((source.name, component.key), count)
                for source in self._gateway.sources
                for component, count in source.fan_out.frames.items()
                if component in source.queries.components
            ],
        )

    def _routes(self) -> Iterator[Metric]:
        """Yield the metrics of what each source passes to each output."""
        routes = [
            (source, output, status)
            for source in self._gateway.sources
            for output, status in source.fan_out.outputs
        ]
        labels = ("source", "output")
        for name, help_text, counts in _ROUTE_COUNTERS:
            yield _counter(
                name,
                help_text,
                (*labels, "component"),
                [
                    sample
                    for source, output, status in routes
                    for sample in _samples(
                        (source.name, output.name),
                        counts(status),
                        [WHOLE_FRAME]
                        if status.takes_frames
                        else [component.key for component in source.queries.components],
                    )
                ],
            )
        yield from _loss_counters(
            "output",
            labels,
            [
                ((source.name, output.name), status.losses, output.drop_causes)
                for source, output, status in routes
            ],
        )

    def _outputs(self) -> Iterator[Metric]:
        yield _gauge(
            "output_connected",
            "1 if the output can send, else 0.",
            ("output",),
            [((output.name,), output.health().connected) for output in self._gateway.outputs],
        )
        yield _counter(
            "queries",
            "Queries by result: ok, or the code of the error in the reply.",
            ("output", "result"),
            [
                sample
                for output in self._gateway.outputs
                if (results := output.query_results) is not None
                for sample in _samples(
                    (output.name,), sum(map(Counter, results.values()), Counter()), ("ok",)
                )
            ],
        )

    def _disks(self) -> Iterator[Metric]:
        facts = self._disk_facts
        yield _gauge(
            "certificate_not_after_timestamp_seconds",
            "When a TLS certificate ends, since the Unix epoch; of several in one file, the first to end.",
            ("output", "key"),
            list(facts.certificate_ends_s.items()),
        )
        yield _gauge(
            "takes_free_bytes",
            "Room on the disk of the takes; absent while the output takes is off.",
            (),
            [] if facts.takes_free_bytes is None else [((), facts.takes_free_bytes)],
        )

    def _process(self) -> Iterator[Metric]:
        yield _gauge(
            "loop_delay_seconds",
            "How late the event loop ran the last measured callback; frames wait just as long.",
            (),
            [((), self._loop_delay.last_s)],
        )
        yield _gauge(
            "loop_delay_max_seconds",
            "Largest of these delays in the last one to two minutes.",
            (),
            [((), self._loop_delay.max_s)],
        )
        yield _counter(
            "host_clock_steps",
            "How often the wall clock of this computer was set by 1 ms or more since the gateway started.",
            (),
            [((), host_clock.steps)],
        )
        yield _counter(
            "defects",
            "Defects of the gateway, repeats included; the log has each with its traceback.",
            (),
            [((), defect_total.count)],
        )
        yield InfoMetricFamily(f"{METRIC_PREFIX}build", "Versions; always 1.", self._build)
        # prometheus_client's own collector reads /proc/stat, which the service's sandbox hides.
        cpu_s = time.process_time()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        memory_bytes = pages * resource.getpagesize()
        yield CounterMetricFamily("process_cpu_seconds", "CPU time of the gateway.", value=cpu_s)
        yield GaugeMetricFamily(
            "process_resident_memory_bytes", "Resident memory of the gateway.", value=memory_bytes
        )


def _loss_counters(
    kind: str, labels: Labels, losses: Sequence[tuple[Labels, Sequence[Loss], Iterable[str]]]
) -> Iterator[Metric]:
    """Yield the counters of lost messages and frames by cause, of each stream or of each output.

    ``losses`` are label values, what was lost, and the causes that are shown from the start.
    """
    for name, help_text, count in _LOSS_COUNTERS[kind]:
        yield _counter(
            name,
            help_text,
            (*labels, "cause"),
            [
                sample
                for values, lost, known in losses
                for sample in _samples(values, {loss.cause: count(loss) for loss in lost}, known)
            ],
        )


def _samples(labels: Labels, counts: Mapping[str, int], known: Iterable[str]) -> Iterator[Sample]:
    """Yield one sample per count, and a 0 for each of the ``known`` names without a count."""
    for name, count in (dict.fromkeys(known, 0) | dict(counts)).items():
        yield (*labels, name), count


def _counter(name: str, help_text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _add_samples(CounterMetricFamily(METRIC_PREFIX + name, help_text, labels=labels), samples)


def _gauge(name: str, help_text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _add_samples(GaugeMetricFamily(METRIC_PREFIX + name, help_text, labels=labels), samples)


def _add_samples(family: CounterMetricFamily | GaugeMetricFamily, samples: Iterable[Sample]) -> Metric:
    for labels, value in samples:
        family.add_metric(labels, value)
    return family
