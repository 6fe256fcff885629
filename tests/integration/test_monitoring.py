"""Monitoring of a running gateway: HTTP, Prometheus' text format, dashboard, alerts and log."""

import asyncio
import json
import logging
import re
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
import uvloop
import yaml
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from gateway.config.settings import (
    MetricsSettings,
    ReconnectSettings,
    SourceSettings,
    StreamSettings,
)
from gateway.errors import OutputError
from gateway.gateway import Gateway
from gateway.log import FIELDS
from gateway.monitoring.server import MonitoringServer
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.components import ComponentType
from gateway.service.log_format import ContextFilter
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.configurations import make_settings
from tests.networks import free_port, zenoh_keys
from tests.toy_output import ToyOutput
from tests.waiting import wait_until_async

ROOT = Path(__file__).parents[2]
OPERATIONS = (ROOT / "docs/operations.md").read_text()
REFERENCE = (ROOT / "docs/reference/metrics.md").read_text()
DASHBOARD: dict[str, Any] = json.loads((ROOT / "config/grafana/rtc3d-gateway.json").read_text())
STREAMS = (
    StreamSettings(components=(ComponentType.MARKERS, ComponentType.TOOLS)),
    StreamSettings(components=(ComponentType.ANALOG,)),
)
PROMETHEUS_LABELS = {"job", "instance"}
"""Labels that Prometheus adds."""


class Lab:
    """A gateway for the source "lab" on ``port``, with Zenoh, LCM and the monitoring server."""

    def __init__(self, port: int, metrics_port: int) -> None:
        self.port = metrics_port
        source = SourceSettings(
            name="lab",
            host="127.0.0.1",
            port=port,
            streams=STREAMS,
            reconnect=ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05),
            stall_timeout_s=1.0,
        )
        settings = make_settings(
            sources=(source,),
            zenoh=ZenohSettings(config=zenoh_keys("peer")),
            lcm=LcmSettings(url="memq://"),
            metrics=MetricsSettings(port=metrics_port),
        )
        self.gateway = Gateway(settings)
        self.monitoring = MonitoringServer(settings.metrics, self.gateway)
        self.source = self.gateway.sources[0]

    async def get(self, path: str) -> tuple[int, str]:
        """Return the HTTP status and the body of a page."""
        return await asyncio.to_thread(self._get, path)

    def _get(self, path: str) -> tuple[int, str]:
        connection = HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        finally:
            connection.close()

    async def health(self) -> tuple[int, dict[str, Any]]:
        status, body = await self.get("/healthz")
        return status, json.loads(body)

    async def scrape(self) -> dict[str, Metric]:
        """Return the metric families by name; the samples have the names that PromQL queries use."""
        status, body = await self.get("/metrics")
        assert status == 200
        return {family.name: family for family in text_string_to_metric_families(body)}

    async def until(self, condition: Callable[[], object]) -> None:
        await wait_until_async(condition)

    async def streaming(self) -> None:
        await self.until(lambda: all(each.state is StreamState.STREAMING for each in self.source.statuses))


@asynccontextmanager
async def running_lab(port: int, metrics_port: int | None = None) -> AsyncIterator[Lab]:
    lab = Lab(port, metrics_port or free_port())
    stop = asyncio.Event()
    task = asyncio.create_task(lab.gateway.run(stop))
    await lab.monitoring.start()
    try:
        async with asyncio.timeout(30):
            await lab.gateway.opened.wait()
        yield lab
    finally:
        await lab.monitoring.close()
        stop.set()
        async with asyncio.timeout(30):
            await task


def simulator(port: int = 0) -> Simulator:
    scene = SyntheticScene(markers=2, tools=1, analog=2, plates=0, rate_hz=100, analog_rate_hz=200)
    return Simulator(scene, port=port)


# Metrics -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def families() -> dict[str, Metric]:
    """Return the metrics of a gateway that has streamed long enough for a valid clock."""

    async def run() -> dict[str, Metric]:
        async with simulator() as server, running_lab(server.port) as lab:
            await lab.until(lambda: all(status.clock.has_clock for status in lab.source.statuses))
            await lab.until(lambda: all(s.messages["status"] for _, s in lab.source.fan_out.outputs))
            return await lab.scrape()

    return uvloop.run(run())


@pytest.fixture(scope="module")
def series(families: dict[str, Metric]) -> dict[str, set[str]]:
    """Return the labels of each sample name."""
    return {sample.name: set(sample.labels) for family in families.values() for sample in family.samples}


def test_frames_and_messages_are_counted_for_both_outputs(families: dict[str, Metric]) -> None:
    frames = {
        sample.labels["component"]: sample.value
        for sample in families["rtc3d_gateway_component_frames"].samples
    }
    assert frames.keys() == {"3d", "6d", "analog"}
    assert min(frames.values()) > 100
    for metric in ("messages", "message_bytes"):
        counted = {
            (sample.labels["output"], sample.labels["component"]): sample.value
            for sample in families[f"rtc3d_gateway_{metric}"].samples
        }
        assert {output for output, _ in counted} == {"zenoh", "lcm"}
        assert min(counted.values()) > 0
    connected = families["rtc3d_gateway_output_connected"].samples
    assert {sample.labels["output"]: sample.value for sample in connected} == {"zenoh": 1, "lcm": 1}


def test_names_and_units_follow_prometheus_conventions(families: dict[str, Metric]) -> None:
    base_units = {"seconds", "bytes", "ratio"}
    others = {"milliseconds", "ms", "us", "microseconds", "minutes", "percent", "ppm", "kilobytes", "hz"}
    for family in families.values():
        assert family.name.startswith(("rtc3d_gateway_", "process_")), family.name
        assert re.fullmatch("[a-z][a-z0-9_]*", family.name), family.name
        assert family.documentation, family.name
        words = family.name.split("_")
        assert not others & set(words), family.name
        assert not base_units & set(words[:-1]), f"{family.name}: the unit comes last"
        suffix = {"counter": "_total"}.get(family.type, "")
        for sample in family.samples:
            assert sample.name == family.name + suffix
            assert family.type != "counter" or sample.value >= 0
        assert family.type in {"counter", "gauge"}, family.name
        assert "total" not in words, family.name
        assert len({frozenset(sample.labels) for sample in family.samples}) <= 1, family.name
        assert not {"le", "quantile", *PROMETHEUS_LABELS} & {
            label for s in family.samples for label in s.labels
        }
        unique = {tuple(sorted(sample.labels.items())) for sample in family.samples}
        assert len(unique) == len(family.samples), family.name


def test_every_metric_has_samples(families: dict[str, Metric]) -> None:
    assert [family.name for family in families.values() if not family.samples] == []


def unit(name: str) -> str:
    """Return the unit in a metric's name."""
    last = name.removesuffix("_total").rpartition("_")[2]
    return {"seconds": "s", "bytes": "bytes", "ratio": "1"}.get(last, "")


def test_the_reference_lists_every_metric_with_type_labels_and_unit(families: dict[str, Metric]) -> None:
    rows = re.findall(
        r"^\| `((?:rtc3d|process)_\w+)` \| (\w+) \| ([\w, ]*?) ?\| (\w*) ?\| ", REFERENCE, re.MULTILINE
    )
    documented = {
        (name, kind, frozenset(filter(None, labels.split(", "))), documented_unit)
        for name, kind, labels, documented_unit in rows
    }
    scraped = {
        (sample.name, family.type, frozenset(sample.labels), unit(sample.name))
        for family in families.values()
        for sample in family.samples
    }
    assert documented == scraped


# Queries -------------------------------------------------------------------------------------

QUERIES = [
    *(target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]),
    *(each["definition"] for each in DASHBOARD["templating"]["list"] if each["type"] == "query"),
]
ALERTS = [
    rule
    for block in re.findall(r"^```yaml\n(groups:.*?)^```$", OPERATIONS, re.MULTILINE | re.DOTALL)
    for group in yaml.safe_load(block)["groups"]
    for rule in group["rules"]
]


def selected(query: str) -> list[tuple[str, str]]:
    """Return each metric of a query with its label selectors."""
    return re.findall(r"\b((?:rtc3d_gateway|process)_\w+)(?:\{([^}]*)\})?", query)


def grouped(query: str) -> set[str]:
    """Return the labels that a query groups by or joins on."""
    lists = re.findall(r"\b(?:by|on|without|ignoring) ?\(([^)]*)\)", query)
    return {label.strip() for labels in lists for label in labels.split(",")}


@pytest.mark.parametrize("query", [*QUERIES, *(rule["expr"] for rule in ALERTS)])
def test_queries_use_existing_metrics_and_labels(query: str, series: dict[str, set[str]]) -> None:
    metrics = selected(query)
    assert metrics or query.startswith("up{")
    known = set().union(*(series[name] for name, _ in metrics)) if metrics else set()
    for name, selectors in metrics:
        labels = set(re.findall(r"(\w+) ?(?:=~|!~|!=|=)", selectors))
        assert labels <= series[name] | PROMETHEUS_LABELS, name
    assert grouped(query) <= known | PROMETHEUS_LABELS


def test_queries_and_the_dashboard_use_existing_states() -> None:
    selected_states = re.findall(
        r'state=~?"([^"]*)"', " ".join([*QUERIES, *(rule["expr"] for rule in ALERTS)])
    )
    states = {state for choice in selected_states for state in choice.split("|")}
    assert states <= {state.value for state in StreamState}
    [timeline] = [panel for panel in DASHBOARD["panels"] if panel["title"] == "Streams"]
    legend = {
        int(number): mapping["text"]
        for number, mapping in timeline["fieldConfig"]["defaults"]["mappings"][0]["options"].items()
    }
    weights = {
        int(number): state
        for state, number in re.findall(r'state="([^"]*)"\} \* (\d)', timeline["targets"][0]["expr"])
    }
    assert weights == legend
    assert set(legend.values()) == {state.value for state in StreamState}


def test_the_dashboard_shows_every_metric(series: dict[str, set[str]]) -> None:
    queried = {name for query in QUERIES for name, _ in selected(query)}
    # The dashboard shows frames per component, and the clock curves end while the clock is not valid.
    hidden = {"rtc3d_gateway_frames_received_total", "rtc3d_gateway_clock_valid"}
    assert queried | hidden == series.keys()


def test_panels_do_not_overlap_and_their_legends_use_existing_labels(series: dict[str, set[str]]) -> None:
    cells: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        position = panel["gridPos"]
        assert position["x"] + position["w"] <= 24
        taken = {
            (column, row)
            for column in range(position["x"], position["x"] + position["w"])
            for row in range(position["y"], position["y"] + position["h"])
        }
        assert not taken & cells, panel["title"]
        cells |= taken
        for target in panel["targets"]:
            [(name, _), *_] = selected(target["expr"])
            by = grouped(target["expr"])
            labels = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
            assert labels <= (by or series[name]), panel["title"]
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def test_alert_summaries_use_existing_labels(series: dict[str, set[str]]) -> None:
    assert len({rule["alert"] for rule in ALERTS}) == len(ALERTS) > 5
    for rule in ALERTS:
        known = set().union(PROMETHEUS_LABELS, *(series[name] for name, _ in selected(rule["expr"])))
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= known, rule["alert"]


# Health --------------------------------------------------------------------------------------


async def test_health_depends_on_the_servers_state() -> None:
    async with simulator() as server, running_lab(server.port) as lab:
        await lab.streaming()
        status, body = await lab.health()
        assert (status, body["healthy"]) == (200, True)
        server.stop_measurement()
        await lab.until(lambda: {each.state for each in lab.source.statuses} == {StreamState.NO_MEASUREMENT})
        assert (await lab.health())[0] == 200
        port = server.port
    async with running_lab(port) as lab:
        await lab.until(lambda: all(each.last_error for each in lab.source.statuses))
        status, body = await lab.health()
        assert (status, body["healthy"]) == (503, False)
        assert [each["stream"] for each in body["streams"]] == ["3d 6d", "analog"]
        assert all(f"refused by 127.0.0.1:{port}" in each["problem"] for each in body["streams"])
        assert body["outputs"] == [{"output": "zenoh", "problem": ""}, {"output": "lcm", "problem": ""}]
        async with simulator(port):
            await lab.streaming()
            assert (await lab.health())[0] == 200


async def test_a_port_in_use_is_logged_once_and_the_gateway_runs(caplog: pytest.LogCaptureFixture) -> None:
    async with simulator() as server, running_lab(server.port) as first:
        caplog.clear()
        async with running_lab(server.port, first.port) as second:
            await second.streaming()
        [warning] = [record for record in caplog.records if record.name == "gateway.monitoring.server"]
    assert warning.levelno == logging.WARNING
    assert f"port {first.port}: " in warning.getMessage()
    assert "metrics.port" in warning.getMessage()


async def test_stopping_the_gateway_frees_the_port() -> None:
    async with simulator() as server:
        async with running_lab(server.port) as lab:
            pass
        async with running_lab(server.port, lab.port) as again:
            assert (await again.get("/metrics"))[0] == 200


# The log -------------------------------------------------------------------------------------


async def test_log_records_of_a_connection_have_its_fields(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with caplog.filtering(ContextFilter()):
        async with simulator() as server, running_lab(server.port) as lab:
            await lab.streaming()
            port = server.port
    logged_fields = [
        tuple(getattr(record, name, "") for name in FIELDS)
        for record in caplog.records
        if record.name in {"gateway.stream.status", "gateway.stream.supervisor", "gateway.stream.session"}
    ]
    assert set(logged_fields) == {("lab", stream, f"127.0.0.1:{port}") for stream in ("3d 6d", "analog")}
    gateway_records = [
        record for record in caplog.records if record.name in {"gateway.monitoring.server", "gateway.gateway"}
    ]
    assert gateway_records
    assert not any(hasattr(record, "source") for record in gateway_records)


async def test_log_records_of_status_messages_have_the_source(
    caplog: pytest.LogCaptureFixture,
) -> None:
    output = ToyOutput()
    output.error = OutputError("no router", cause="no router")
    sources = tuple(SourceSettings(name=name, host="127.0.0.1") for name in ("hall", "lab"))
    gateway = Gateway(make_settings(sources=sources, metrics=MetricsSettings(enabled=False)), [output])
    with caplog.filtering(ContextFilter()):
        for source in gateway.sources:
            source.publish_status()
    logged = [(getattr(record, "source", ""), record.message) for record in caplog.records]
    assert logged == [("hall", "hall to toy: no router"), ("lab", "lab to toy: no router")]


async def test_the_log_format_option_selects_the_format() -> None:
    arguments = ("simulate", "--port", "0", "--seconds", "0.1", "--log-format", "json")
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", *arguments), stderr=asyncio.subprocess.PIPE
    )
    _, errors = await program.communicate()
    assert program.returncode == 0
    lines = [json.loads(line) for line in errors.splitlines()]
    assert {"info"} == {line["level"] for line in lines}
    assert all(line["logger"].startswith("gateway.rtc3d_server") for line in lines)
