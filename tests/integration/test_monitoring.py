"""A gateway that is watched as in a lab: HTTP, Prometheus' text, the dashboard, the alerts, the log."""

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
    LcmSettings,
    MetricsSettings,
    ReconnectSettings,
    Settings,
    SourceSettings,
    StreamSettings,
    ZenohSettings,
)
from gateway.errors import OutputError
from gateway.gateway import Gateway
from gateway.log import FIELDS, FieldsFilter
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.server import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
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
OF_PROMETHEUS = {"job", "instance"}
"""Labels that Prometheus itself adds."""


class Watched:
    """A gateway of the source "lab" to a server on ``port``, with Zenoh and LCM, and its HTTP side."""

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
        settings = Settings(
            sources=(source,),
            zenoh=ZenohSettings(config=zenoh_keys("peer")),
            lcm=LcmSettings(url="memq://"),
            metrics=MetricsSettings(port=metrics_port),
        )
        self.gateway = Gateway(settings)
        self.source = self.gateway.sources[0]

    async def get(self, path: str) -> tuple[int, str]:
        """Return the status and the body of a page."""
        return await asyncio.to_thread(self._get, path)

    def _get(self, path: str) -> tuple[int, str]:
        connection = HTTPConnection("127.0.0.1", self.port, timeout=10)
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
        """Return the metric families by name; their samples have the names that queries use."""
        status, body = await self.get("/metrics")
        assert status == 200
        return {family.name: family for family in text_string_to_metric_families(body)}

    async def until(self, condition: Callable[[], object]) -> None:
        await wait_until_async(condition)

    async def streaming(self) -> None:
        await self.until(lambda: all(each.state is StreamState.STREAMING for each in self.source.statuses))


@asynccontextmanager
async def watched(port: int, metrics_port: int | None = None) -> AsyncIterator[Watched]:
    lab = Watched(port, metrics_port or free_port())
    stop = asyncio.Event()
    task = asyncio.create_task(lab.gateway.run(stop))
    try:
        async with asyncio.timeout(10):
            await lab.gateway.opened.wait()
        yield lab
    finally:
        stop.set()
        async with asyncio.timeout(10):
            await task


def simulator(port: int = 0) -> Simulator:
    scene = SyntheticScene(markers=2, tools=1, analog=2, plates=0, rate_hz=100, analog_rate_hz=200)
    return Simulator(scene, port=port)


# What is scraped -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def families() -> dict[str, Metric]:
    """Return what a gateway that has streamed long enough to know the clock is scraped for."""

    async def run() -> dict[str, Metric]:
        async with simulator() as server, watched(server.port) as lab:
            await lab.until(lambda: all(status.clock.has_clock for status in lab.source.statuses))
            await lab.until(lambda: all(s.messages["status"] for _, s in lab.source.fan_out.outputs))
            return await lab.scrape()

    return uvloop.run(run())


@pytest.fixture(scope="module")
def series(families: dict[str, Metric]) -> dict[str, set[str]]:
    """Return the labels of each name that queries use."""
    return {sample.name: set(sample.labels) for family in families.values() for sample in family.samples}


def test_frames_and_messages_are_counted_on_both_outputs(families: dict[str, Metric]) -> None:
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


def test_names_and_units_are_as_prometheus_asks(families: dict[str, Metric]) -> None:
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
        assert not {"le", "quantile", *OF_PROMETHEUS} & {label for s in family.samples for label in s.labels}
        unique = {tuple(sorted(sample.labels.items())) for sample in family.samples}
        assert len(unique) == len(family.samples), family.name


def test_every_metric_has_samples(families: dict[str, Metric]) -> None:
    assert [family.name for family in families.values() if not family.samples] == []


def unit(name: str) -> str:
    """Return the unit that a metric's name tells."""
    last = name.removesuffix("_total").rpartition("_")[2]
    return {"seconds": "s", "bytes": "bytes", "ratio": "1"}.get(last, "")


def test_the_references_table_is_the_truth(families: dict[str, Metric]) -> None:
    rows = re.findall(
        r"^\| `((?:rtc3d|process)_\w+)` \| (\w+) \| ([\w, ]*?) ?\| (\w*) ?\| ", REFERENCE, re.MULTILINE
    )
    told = {
        (name, kind, frozenset(filter(None, labels.split(", "))), told_unit)
        for name, kind, labels, told_unit in rows
    }
    scraped = {
        (sample.name, family.type, frozenset(sample.labels), unit(sample.name))
        for family in families.values()
        for sample in family.samples
    }
    assert told == scraped


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
    """Return each metric of a query with what stands behind it in braces."""
    return re.findall(r"\b((?:rtc3d_gateway|process)_\w+)(?:\{([^}]*)\})?", query)


def grouped(query: str) -> set[str]:
    """Return the labels that a query groups by or joins on."""
    lists = re.findall(r"\b(?:by|on|without|ignoring) ?\(([^)]*)\)", query)
    return {label.strip() for labels in lists for label in labels.split(",")}


@pytest.mark.parametrize("query", [*QUERIES, *(rule["expr"] for rule in ALERTS)])
def test_queries_ask_for_metrics_and_labels_that_exist(query: str, series: dict[str, set[str]]) -> None:
    metrics = selected(query)
    assert metrics or query.startswith("up{")
    known = set().union(*(series[name] for name, _ in metrics)) if metrics else set()
    for name, selectors in metrics:
        labels = set(re.findall(r"(\w+) ?(?:=~|!~|!=|=)", selectors))
        assert labels <= series[name] | OF_PROMETHEUS, name
    assert grouped(query) <= known | OF_PROMETHEUS


def test_states_in_queries_are_those_that_there_are() -> None:
    asked = re.findall(r'state=~?"([^"]*)"', " ".join([*QUERIES, *(rule["expr"] for rule in ALERTS)]))
    states = {state for choice in asked for state in choice.split("|")}
    assert states <= {state.value for state in StreamState}
    [timeline] = [panel for panel in DASHBOARD["panels"] if panel["title"] == "Streams"]
    shown = {
        int(number): mapping["text"]
        for number, mapping in timeline["fieldConfig"]["defaults"]["mappings"][0]["options"].items()
    }
    weights = {
        int(number): state
        for state, number in re.findall(r'state="([^"]*)"\} \* (\d)', timeline["targets"][0]["expr"])
    }
    assert weights == shown
    assert set(shown.values()) == {state.value for state in StreamState}


def test_the_dashboard_shows_every_metric(series: dict[str, set[str]]) -> None:
    asked = {name for query in QUERIES for name, _ in selected(query)}
    # Per component is seen instead; the clock's curves end when it is not valid.
    hidden = {"rtc3d_gateway_frames_received_total", "rtc3d_gateway_clock_valid"}
    assert asked | hidden == series.keys()


def test_panels_have_places_of_their_own_and_legends_that_name_labels(series: dict[str, set[str]]) -> None:
    cells: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        taken = {
            (column, row)
            for column in range(place["x"], place["x"] + place["w"])
            for row in range(place["y"], place["y"] + place["h"])
        }
        assert not taken & cells, panel["title"]
        cells |= taken
        for target in panel["targets"]:
            [(name, _), *_] = selected(target["expr"])
            by = grouped(target["expr"])
            labels = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
            assert labels <= (by or series[name]), panel["title"]
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def test_alerts_say_what_is_wrong_with_labels_that_exist(series: dict[str, set[str]]) -> None:
    assert len({rule["alert"] for rule in ALERTS}) == len(ALERTS) > 5
    for rule in ALERTS:
        known = set().union(OF_PROMETHEUS, *(series[name] for name, _ in selected(rule["expr"])))
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= known, rule["alert"]


# Health --------------------------------------------------------------------------------------


async def test_health_follows_the_server() -> None:
    async with simulator() as server, watched(server.port) as lab:
        await lab.streaming()
        status, body = await lab.health()
        assert (status, body["healthy"]) == (200, True)
        server.stop_measurement()
        await lab.until(lambda: {each.state for each in lab.source.statuses} == {StreamState.NO_MEASUREMENT})
        assert (await lab.health())[0] == 200
        port = server.port
    async with watched(port) as lab:
        await lab.until(lambda: all(each.last_error for each in lab.source.statuses))
        status, body = await lab.health()
        assert (status, body["healthy"]) == (503, False)
        assert [each["stream"] for each in body["streams"]] == ["3d 6d", "analog"]
        assert all(f"refused by 127.0.0.1:{port}" in each["problem"] for each in body["streams"])
        assert body["outputs"] == [{"output": "zenoh", "problem": ""}, {"output": "lcm", "problem": ""}]
        async with simulator(port):
            await lab.streaming()
            assert (await lab.health())[0] == 200


async def test_a_port_in_use_is_told_once_and_the_gateway_runs_on(caplog: pytest.LogCaptureFixture) -> None:
    async with simulator() as server, watched(server.port) as first:
        caplog.clear()
        async with watched(server.port, first.port) as second:
            await second.streaming()
        [warning] = [record for record in caplog.records if record.name == "gateway.monitoring.server"]
    assert warning.levelno == logging.WARNING
    assert f"port {first.port}: " in warning.getMessage()
    assert "metrics.port" in warning.getMessage()


async def test_the_port_is_free_again_once_the_gateway_has_stopped() -> None:
    async with simulator() as server:
        async with watched(server.port) as lab:
            pass
        async with watched(server.port, lab.port) as again:
            assert (await again.get("/metrics"))[0] == 200


# The log -------------------------------------------------------------------------------------


async def test_what_is_logged_of_a_connection_says_of_which(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with caplog.filtering(FieldsFilter()):
        async with simulator() as server, watched(server.port) as lab:
            await lab.streaming()
            port = server.port
    told = [
        tuple(getattr(record, name, "") for name in FIELDS)
        for record in caplog.records
        if record.name in {"gateway.stream.status", "gateway.stream.supervisor", "gateway.stream.session"}
    ]
    assert set(told) == {("lab", stream, f"127.0.0.1:{port}") for stream in ("3d 6d", "analog")}
    of_the_whole = [
        record for record in caplog.records if record.name in {"gateway.monitoring.server", "gateway.gateway"}
    ]
    assert of_the_whole
    assert not any(hasattr(record, "source") for record in of_the_whole)


async def test_what_is_logged_of_status_messages_says_of_which_source(
    caplog: pytest.LogCaptureFixture,
) -> None:
    output = ToyOutput()
    output.error = OutputError("no router", cause="no router")
    sources = tuple(SourceSettings(name=name, host="127.0.0.1") for name in ("hall", "lab"))
    gateway = Gateway(Settings(sources=sources, metrics=MetricsSettings(enabled=False)), [output])
    with caplog.filtering(FieldsFilter()):
        for source in gateway.sources:
            source.publish_status()
    told = [(getattr(record, "source", ""), record.message) for record in caplog.records]
    assert told == [("hall", "hall to toy: no router"), ("lab", "lab to toy: no router")]


async def test_a_program_writes_the_form_of_log_that_it_is_asked_for() -> None:
    arguments = ("simulate", "--port", "0", "--seconds", "0.1", "--log-format", "json")
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", *arguments), stderr=asyncio.subprocess.PIPE
    )
    _, errors = await program.communicate()
    assert program.returncode == 0
    lines = [json.loads(line) for line in errors.splitlines()]
    assert {"info"} == {line["level"] for line in lines}
    assert all(line["logger"].startswith("gateway.simulator") for line in lines)
