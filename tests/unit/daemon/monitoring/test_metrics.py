"""Metrics of counters with known values, parsed by Prometheus' own parser."""

import logging
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from gateway import __version__
from gateway.config.settings import MetricsSettings, SourceSettings, StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring import metrics
from gateway.daemon.monitoring.metrics import GatewayMetrics
from gateway.daemon.monitoring.process_limits import DiskFacts, LoopDelay
from gateway.errors import OutputError
from gateway.messages.encode import Stamp
from gateway.messages.host_time import HostClock, host_clock
from gateway.rtc3d.client_protocol import ProtocolState
from gateway.rtc3d.components import ComponentType, encode_component
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.runtime.failures import DefectLog
from gateway.session.state import StreamState
from tests.support.configurations import make_settings
from tests.support.example_output import ExampleOutput, ExampleSettings
from tests.support.toy_output import ToyOutput

STREAMS = (
    StreamSettings(components=(ComponentType.MARKERS, ComponentType.TOOLS)),
    StreamSettings(components=(ComponentType.ANALOG,)),
)


class Lab:
    """A gateway with two streams and two outputs that is not running."""

    def __init__(self) -> None:
        settings = make_settings(
            sources=(SourceSettings(name="lab", host="192.0.2.20", streams=STREAMS),),
            metrics=MetricsSettings(enabled=False),
        )
        self.outputs = [ToyOutput("zenoh"), ToyOutput("toy")]
        self.gateway = Gateway(settings, self.outputs)
        self.source = self.gateway.sources[0]
        self.markers, self.analog = self.source.statuses
        self.loop_delay = LoopDelay()
        self._metrics = GatewayMetrics(self.gateway, self.loop_delay, DiskFacts(self.gateway))

    def families(self) -> list[Metric]:
        page = self._metrics.page()
        assert page.status == 200
        return list(text_string_to_metric_families(page.body.decode()))

    def samples(self, name: str) -> Iterator[tuple[dict[str, str], float]]:
        for family in self.families():
            for sample in family.samples:
                if sample.name == f"rtc3d_gateway_{name}":
                    yield dict(sample.labels), sample.value

    def value(self, name: str, **labels: str) -> float:
        [value] = [value for found, value in self.samples(name) if found == labels]
        return value

    def values_by(self, name: str, label: str, where: dict[str, str] | None = None) -> dict[str, float]:
        """Return the values of the series with the labels ``where``, by another label."""
        wanted = (where or {}).items()
        return {labels[label]: value for labels, value in self.samples(name) if wanted <= labels.items()}


def analog_frame() -> RawFrame:
    """Return a frame with one analog component of three channels."""
    analog = encode_component(ComponentType.ANALOG, 1, 1, np.zeros(3, ">f4"))
    return split_frame(encode_frame([analog]), "big")


@pytest.fixture
async def lab() -> Lab:
    return Lab()


MARKERS = {"source": "lab", "stream": "3d 6d"}
ANALOG = {"source": "lab", "stream": "analog"}


async def test_every_stream_has_its_counters(lab: Lab) -> None:
    lab.markers.frames_in, lab.analog.frames_in, lab.markers.bytes_in = 7, 70, 1000
    lab.markers.connections, lab.markers.reconnects, lab.markers.restarts = 3, 5, 2
    lab.markers.last_frame_utime = 1_700_000_000_250_000
    lab.markers.lag_s = 0.125
    names = ("frames_received", "received_bytes", "sessions", "reconnects", "server_restarts")
    assert [lab.value(f"{name}_total", **MARKERS) for name in names] == [7, 1000, 3, 5, 2]
    assert lab.value("frames_received_total", **ANALOG) == 70
    assert lab.value("lag_seconds", **MARKERS) == 0.125
    assert list(lab.samples("last_frame_timestamp_seconds")) == [(MARKERS, 1_700_000_000.25)]


async def test_alerts_learn_of_defects_and_of_nobody_who_subscribes(lab: Lab) -> None:
    before = lab.value("defects_total")
    for _ in range(2):
        DefectLog(logging.getLogger(), "lab").log(KeyError("x"))
    assert lab.value("defects_total") == before + 2
    assert lab.value("source_subscribed", source="lab") == 0
    lab.outputs[0].wanted.add("3d")
    assert lab.value("source_subscribed", source="lab") == 1


async def test_exactly_one_state_of_a_stream_is_1(lab: Lab) -> None:
    lab.markers.connecting("server")
    lab.markers.connected("server")
    lab.markers.protocol_changed(ProtocolState.STREAMING, "big", "server")
    states = lab.values_by("stream_state", "state", MARKERS)
    assert states == {state.value: float(state is StreamState.STREAMING) for state in StreamState}


async def test_drops_have_a_cause_and_common_causes_start_at_0(lab: Lab) -> None:
    for _ in range(2):
        lab.markers.frame_rejected("too short", 3)
    lab.markers.losses.lost("quite unusual", "lost", frames=0)
    zenoh, toy = lab.outputs
    zenoh.error, toy.error = OutputError("stalled", cause="queue full"), ValueError("oops")
    lab.source.fan_out.publish_status(b"message")
    causes = ("unknown component", "skipped while behind", "not sent by the server", "C3D file")
    expected = dict.fromkeys(causes, 0) | {"frame rejected": 2, "quite unusual": 1}
    assert lab.values_by("stream_drops_total", "cause", MARKERS) == expected
    assert lab.values_by("output_drops_total", "cause", {"output": "zenoh"}) == {"broken": 0, "queue full": 1}
    assert lab.values_by("output_drops_total", "cause", {"output": "toy"}) == {"broken": 0, "ValueError": 1}


async def test_messages_bytes_and_frames_are_counted_by_component(lab: Lab) -> None:
    fan_out = lab.source.fan_out
    for _ in range(4):
        fan_out.publish(analog_frame(), Stamp(2, 1, 1, 1), frozenset({ComponentType.ANALOG}))
    fan_out.publish_status(bytes(50))
    none, toy = {"3d": 0, "6d": 0}, {"output": "toy"}
    assert lab.values_by("messages_total", "component", toy) == none | {"analog": 4, "status": 1}
    num_bytes = 4 * (56 + 3 * 4)
    assert lab.values_by("message_bytes_total", "component", toy) == none | {
        "analog": num_bytes,
        "status": 50,
    }
    assert lab.values_by("component_frames_total", "component") == none | {"analog": 4}


async def test_an_output_of_whole_frames_has_one_series_for_them(lab: Lab) -> None:
    example = ExampleOutput(ExampleSettings(enabled=True, whole_frames=True))
    example.start()
    lab.source.fan_out.set_outputs([example])
    for count in range(2):
        assert lab.values_by("messages_total", "component") == {"frame": count}
        lab.source.fan_out.publish(analog_frame(), Stamp(2, 1, 1, 1), frozenset({ComponentType.ANALOG}))


async def test_clock_metrics_appear_once_the_clock_is_valid(lab: Lab) -> None:
    boot_us = 3_600_000_000
    assert lab.value("clock_valid", **MARKERS) == 0
    for name in ("clock_offset_seconds", "clock_drift_ratio", "clock_uncertainty_seconds"):
        assert not list(lab.samples(name))
    for number in range(400):  # 4 s at 100 Hz, without jitter
        lab.markers.clock.observe(10_000 * number, number, boot_us + 10_000 * number)
    assert lab.value("clock_valid", **MARKERS) == 1
    assert lab.value("clock_offset_seconds", **MARKERS) == (boot_us + host_clock.offset_us) / 1e6
    assert lab.value("clock_drift_ratio", **MARKERS) == lab.markers.clock.drift_ppm / 1e6
    assert lab.value("clock_uncertainty_seconds", **MARKERS) == lab.markers.clock.uncertainty_us / 1e6
    assert math.isfinite(lab.value("clock_uncertainty_seconds", **MARKERS))


@pytest.mark.interpreted
async def test_steps_of_the_wall_clock_are_counted(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock()
    monkeypatch.setattr("gateway.daemon.monitoring.metrics.host_clock", clock)
    assert lab.value("host_clock_steps_total") == 0
    clock.offset_us += 500_000
    clock.read()
    assert lab.value("host_clock_steps_total") == 1


async def test_outputs_loop_delay_versions_and_the_process_are_reported(lab: Lab) -> None:
    lab.loop_delay.record(0.0, 0.5)
    lab.loop_delay.record(0.1, 0.25)
    assert lab.value("output_connected", output="zenoh") == 1
    assert (lab.value("loop_delay_seconds"), lab.value("loop_delay_max_seconds")) == (0.25, 0.5)
    [(versions, one)] = lab.samples("build_info")
    assert (versions["version"], one) == (__version__, 1)
    assert versions.keys() == {"version", "python", "zenoh", "lcm"}
    samples = {sample.name: sample.value for family in lab.families() for sample in family.samples}
    assert samples["process_cpu_seconds_total"] > 0
    assert samples["process_resident_memory_bytes"] > 1_000_000


@pytest.mark.interpreted
async def test_the_page_is_there_without_the_memory_if_no_file_can_be_opened(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With 64 files at most, "defect in the gateway" was logged instead of what the health says."""
    monkeypatch.setattr(metrics, "_STATM", tmp_path / "absent")
    names = {sample.name for family in lab.families() for sample in family.samples}
    assert "process_cpu_seconds_total" in names
    assert "process_resident_memory_bytes" not in names


async def test_texts_from_the_network_add_no_series(lab: Lab) -> None:
    def names() -> set[tuple[str, ...]]:
        return {(each.name, *each.labels.values()) for family in lab.families() for each in family.samples}

    before = names()
    lab.markers.record_error("a text from a server")
    lab.markers.add_limitation("the server refused something")
    assert names() == before
