"""Prometheus' metrics, made from the counters that exist when they are asked for.

So the data path knows nothing of them. Labels are what the configuration and this program name
(sources, streams, components, outputs, causes, states), never what comes from a network: the number of
series is bounded.
"""

import platform
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from gateway import __version__
from gateway.monitoring.http_pages import Page
from gateway.monitoring.loop_delay import LoopDelay
from gateway.monitoring.monitored import Watched
from gateway.stream.clock import ServerClock
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus

PREFIX: Final = "rtc3d_gateway_"

# Counted from 0 on, so that the first drop is seen as an increase; other causes appear with their first.
_STREAM_CAUSES: Final = ("frame rejected", "unknown component", "skipped while behind")
_OUTPUT_CAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    "zenoh": ("not open", "no router", "put failed"),
    "lcm": ("not open", "send failed"),
}

Labels = tuple[str, ...]
Sample = tuple[Labels, float]
"""The labels' values, and the value."""


class _OfStreams(NamedTuple):
    """A metric with one value per stream; None where there is none now."""

    name: str
    text: str
    value: Callable[[StreamStatus], float | None]


def _of_clock(value: Callable[[ServerClock], float]) -> Callable[[StreamStatus], float | None]:
    return lambda status: value(status.clock) if status.clock.has_clock else None


_STREAM_COUNTERS: Final = (
    _OfStreams("frames_received", "Frames received from the server.", lambda it: it.frames_in),
    _OfStreams("received_bytes", "Bytes received from the server.", lambda it: it.bytes_in),
    _OfStreams("sessions", "Connections that were made with the server.", lambda it: it.session),
    _OfStreams("reconnects", "Tries to connect after the first.", lambda it: it.reconnects),
    _OfStreams(
        "server_restarts",
        "How often frame numbers or time stamps began anew within a connection.",
        lambda it: it.restarts,
    ),
)
_STREAM_GAUGES: Final = (
    _OfStreams(
        "last_frame_timestamp_seconds",
        "When the newest frame came, since the Unix epoch; absent before the first.",
        lambda it: it.last_frame_utime / 1e6 if it.last_frame_utime else None,
    ),
    _OfStreams(
        "lag_seconds",
        "By how much the newest frame came later than the soonest possible.",
        lambda it: it.lag_s,
    ),
    _OfStreams(
        "clock_valid",
        "1 while the server's time stamps make a clock, else 0, and the other clock metrics are absent.",
        lambda it: it.clock.has_clock,
    ),
    _OfStreams(
        "clock_offset_seconds", "Host time minus server time.", _of_clock(lambda it: it.offset_us / 1e6)
    ),
    _OfStreams(
        "clock_drift_ratio",
        "By how much the host's clock is faster than the server's; 1e-6 is 1 ppm.",
        _of_clock(lambda it: it.drift_ppm / 1e6),
    ),
    _OfStreams(
        "clock_uncertainty_seconds",
        "By how much the clock may be wrong, the network's least delay aside; +Inf at first.",
        _of_clock(lambda it: it.uncertainty_us / 1e6),
    ),
)


def metrics_registry(gateway: Watched, loop_delay: LoopDelay) -> CollectorRegistry:
    """Return what /metrics serves."""
    registry = CollectorRegistry()
    registry.register(GatewayCollector(gateway, loop_delay))
    return registry


def metrics_page(registry: CollectorRegistry) -> Page:
    """Return /metrics in Prometheus' text format."""
    return Page(HTTPStatus.OK, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(registry))


class GatewayCollector(Collector):
    """Reads a gateway's counters, in the thread of its event loop."""

    def __init__(self, gateway: Watched, loop_delay: LoopDelay) -> None:
        self._gateway = gateway
        self._loop_delay = loop_delay
        self._build = {
            "version": __version__,
            "python": platform.python_version(),
            "zenoh": version("eclipse-zenoh"),
            "lcm": version("lcm"),
        }

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with what is counted now."""
        yield from self._streams()
        yield from self._components()
        yield from self._outputs()
        yield from self._process()

    def _streams(self) -> Iterator[Metric]:
        streams = [
            ((source.source.name, status.components), status)
            for source in self._gateway.sources
            for status in source.statuses
        ]
        labels = ("source", "stream")
        for kind, metrics in ((_counter, _STREAM_COUNTERS), (_gauge, _STREAM_GAUGES)):
            for name, text, value in metrics:
                samples = [
                    (stream, number) for stream, status in streams if (number := value(status)) is not None
                ]
                yield kind(name, text, labels, samples)
        yield _gauge(
            "stream_state",
            "1 for the state that the stream is in, 0 for the others.",
            (*labels, "state"),
            [
                ((*stream, state.value), state is status.state)
                for stream, status in streams
                for state in StreamState
            ],
        )
        yield _counter(
            "stream_drops",
            "Frames or components that came and were not published, by cause.",
            (*labels, "cause"),
            [sample for stream, status in streams for sample in _each(stream, status.drops, _STREAM_CAUSES)],
        )

    def _components(self) -> Iterator[Metric]:
        yield _counter(
            "component_frames",
            "Frames that had the component to publish, those that an output's max_rate_hz left out too.",
            ("source", "component"),
            [
                ((source.source.name, kind.key), count)
                for source in self._gateway.sources
                for kind, count in source.fan_out.frames.items()
                if kind in source.desk.components
            ],
        )
        ways = [
            ((source.source.name, output.name), status, [kind.key for kind in source.desk.components])
            for source in self._gateway.sources
            for output, status in source.fan_out.outputs
        ]
        labels = ("source", "output")
        yield _counter(
            "messages",
            "Messages handed to the output; 6d/tool, status and clock count as components of their own.",
            (*labels, "component"),
            [sample for way, status, kinds in ways for sample in _each(way, status.messages, kinds)],
        )
        yield _counter(
            "message_bytes",
            "Bytes of these messages, without what Zenoh, LCM and the network add.",
            (*labels, "component"),
            [sample for way, status, kinds in ways for sample in _each(way, status.message_bytes, kinds)],
        )
        yield _counter(
            "output_drops",
            "Messages that the output did not take, and LCM requests not answered, by cause.",
            (*labels, "cause"),
            [
                sample
                for way, status, _ in ways
                for sample in _each(way, status.drops, _OUTPUT_CAUSES.get(way[-1], ()))
            ],
        )

    def _outputs(self) -> Iterator[Metric]:
        yield _gauge(
            "output_connected",
            "1 while the output can send, else 0.",
            ("output",),
            [((output.name,), output.health().connected) for output in self._gateway.outputs],
        )
        yield _counter(
            "queries",
            "Questions of peers by result: ok, or the code of the error that was the answer.",
            ("output", "result"),
            [
                sample
                for output, results in self._gateway.query_results.items()
                for sample in _each((output,), results, ("ok",))
            ],
        )

    def _process(self) -> Iterator[Metric]:
        yield _gauge(
            "loop_delay_seconds",
            "How late the event loop called back when that was last measured; frames wait as long.",
            (),
            [((), self._loop_delay.last_s)],
        )
        yield _gauge(
            "loop_delay_max_seconds",
            "The largest such delay of the last one to two minutes.",
            (),
            [((), self._loop_delay.max_s)],
        )
        yield InfoMetricFamily(f"{PREFIX}build", "Versions; always 1.", self._build)
        # Under their usual names; prometheus_client's own need /proc/stat, which a service's sandbox hides.
        cpu_s = time.process_time()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        memory_bytes = pages * resource.getpagesize()
        yield CounterMetricFamily("process_cpu_seconds", "CPU time of the gateway.", value=cpu_s)
        yield GaugeMetricFamily("process_resident_memory_bytes", "Memory of the gateway.", value=memory_bytes)


def _each(labels: Labels, counts: Mapping[str, int], known: Iterable[str]) -> Iterator[Sample]:
    """Yield one sample per count, and a 0 for those ``known`` that have none."""
    for name, count in (dict.fromkeys(known, 0) | dict(counts)).items():
        yield (*labels, name), count


def _counter(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _filled(CounterMetricFamily(PREFIX + name, text, labels=labels), samples)


def _gauge(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    return _filled(GaugeMetricFamily(PREFIX + name, text, labels=labels), samples)


def _filled(family: CounterMetricFamily | GaugeMetricFamily, samples: Iterable[Sample]) -> Metric:
    for labels, value in samples:
        family.add_metric(labels, value)
    return family
