"""Monitoring of a running gateway: HTTP, Prometheus' text format, dashboard, alerts and log."""

import asyncio
import contextlib
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
from gateway.gateway import Gateway
from gateway.monitoring.health import health_page
from gateway.monitoring.server import MonitoringServer
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from tests.configurations import make_settings
from tests.losses import amounts
from tests.memory_gateway import run_gateway
from tests.networks import free_port, zenoh_keys
from tests.running_gateway import running_gateway
from tests.servers import ScriptedServer, markers_frame, ok, packet
from tests.waiting import wait_until_async

ROOT = Path(__file__).parents[2]
OPERATIONS = (ROOT / "docs/operations.md").read_text()
REFERENCE = (ROOT / "docs/reference/metrics.md").read_text()
DASHBOARD: dict[str, Any] = json.loads((ROOT / "config/grafana/rtc3d-gateway.json").read_text())
STREAMS = (
    StreamSettings(components=(ComponentType.MARKERS, ComponentType.TOOLS)),
    StreamSettings(components=(ComponentType.ANALOG,)),
)
TLS = {
    "shared_memory": {"enabled": False},
    "link": {"tls": {"root_ca_certificate": str(ROOT / "tests/data/certificates/far.crt")}},
}
"""A certificate that is not used without TLS, but has an end."""

PROMETHEUS_LABELS = {"job", "instance"}
"""Labels that Prometheus adds."""


class Lab:
    """A gateway for the source "lab", with Zenoh, LCM and the monitoring server."""

    def __init__(self, server_port: int, port: int) -> None:
        self.port = port
        reconnect = ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05)
        source: dict[str, Any] = {"name": "lab", "host": "127.0.0.1", "port": server_port, "streams": STREAMS}
        self.gateway = Gateway(
            make_settings(
                sources=(SourceSettings(**source, reconnect=reconnect, stall_timeout_s=60.0),),
                zenoh=ZenohSettings(config=zenoh_keys("peer") | {"transport": TLS}),
                lcm=LcmSettings(url="memq://"),
                metrics=MetricsSettings(port=port),
            )
        )
        self.source = self.gateway.sources[0]
        # Only for the metrics: the output itself publishes no status.
        takes = TakesSettings(enabled=True, directory="/tmp")
        self.gateway.settings = self.gateway.settings.model_copy(update={"takes": takes})

    async def get(self, path: str) -> tuple[int, str]:
        """Return the HTTP status and the body of a page."""

        def read() -> tuple[int, str]:
            with contextlib.closing(HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
                connection.request("GET", path)
                answer = connection.getresponse()
                return answer.status, answer.read().decode()

        return await asyncio.to_thread(read)

    async def health(self) -> tuple[int, dict[str, Any]]:
        status, body = await self.get("/healthz")
        return status, json.loads(body)

    async def until_all(self, condition: Callable[[StreamStatus], object]) -> None:
        await wait_until_async(lambda: all(condition(status) for status in self.source.statuses))

    async def streaming(self) -> None:
        await self.until_all(lambda status: status.state is StreamState.STREAMING)


@asynccontextmanager
async def running_lab(server_port: int, port: int | None = None) -> AsyncIterator[Lab]:
    lab = Lab(server_port, port or free_port())
    monitoring = MonitoringServer(lab.gateway.settings.metrics, lab.gateway)
    async with running_gateway(lab.gateway):
        await monitoring.start()
        try:
            yield lab
        finally:
            await monitoring.close()


def simulator(port: int = 0) -> Simulator:
    scene = SyntheticScene(markers=2, tools=1, analog=2, plates=0, rate_hz=100, analog_rate_hz=200)
    return Simulator(scene, port=port)


@pytest.fixture(scope="module")
def families() -> dict[str, Metric]:
    """Return the metrics, by name, of a gateway that has streamed long enough for a valid clock."""

    async def run() -> dict[str, Metric]:
        async with simulator() as server, running_lab(server.port) as lab:
            await lab.until_all(lambda status: status.clock.has_clock)
            await wait_until_async(lambda: all(s.messages["status"] for _, s in lab.source.fan_out.outputs))
            body = ""
            while "certificate_not_after_timestamp_seconds{" not in body:  # read in a thread
                status, body = await lab.get("/metrics")
                assert status == 200
            return {family.name: family for family in text_string_to_metric_families(body)}

    return uvloop.run(run())


def test_frames_and_messages_are_counted_for_both_outputs(families: dict[str, Metric]) -> None:
    frames = families["rtc3d_gateway_component_frames"].samples
    assert {sample.labels["component"] for sample in frames} == {"3d", "6d", "analog"}
    assert min(sample.value for sample in frames) > 100
    for metric in ("messages", "message_bytes", "output_connected"):
        samples = families[f"rtc3d_gateway_{metric}"].samples
        assert {sample.labels["output"] for sample in samples} == {"zenoh", "lcm"}
        assert min(sample.value for sample in samples) > 0


def test_names_and_units_follow_prometheus_conventions(families: dict[str, Metric]) -> None:
    base_units = {"seconds", "bytes", "ratio"}
    others = {"milliseconds", "ms", "us", "microseconds", "minutes", "percent", "ppm", "kilobytes", "hz"}
    for name, family in families.items():
        words = name.split("_")
        assert re.fullmatch("(rtc3d_gateway|process)_[a-z][a-z0-9_]*", name), name
        assert not {"total", *others} & set(words), name
        assert not base_units & set(words[:-1]), f"{name}: the unit comes last"
        assert family.documentation, name
        assert family.type in {"counter", "gauge"}, name
        suffix = "_total" if family.type == "counter" else ""
        assert {sample.name for sample in family.samples} == {name + suffix}
        assert len({frozenset(sample.labels) for sample in family.samples}) == 1, name
        labels = {label for sample in family.samples for label in sample.labels}
        assert not {"le", "quantile", *PROMETHEUS_LABELS} & labels, name
        unique = {tuple(sorted(sample.labels.items())) for sample in family.samples}
        assert len(unique) == len(family.samples), name


@pytest.fixture(scope="module")
def series(families: dict[str, Metric]) -> dict[str, set[str]]:
    """Return the labels of each sample name."""
    return {sample.name: set(sample.labels) for family in families.values() for sample in family.samples}


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
    for group in yaml.safe_load((ROOT / "config/prometheus/rtc3d-gateway.yaml").read_text())["groups"]
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
    queries = " ".join([*QUERIES, *(rule["expr"] for rule in ALERTS)])
    states = {state.value for state in StreamState}
    used = {state for choice in re.findall(r'state=~?"([^"]*)"', queries) for state in choice.split("|")}
    assert used <= states
    [timeline] = [panel for panel in DASHBOARD["panels"] if panel["title"] == "Streams"]
    legend = timeline["fieldConfig"]["defaults"]["mappings"][0]["options"]
    weights = dict(re.findall(r'state="([^"]*)"\} \* (\d)', timeline["targets"][0]["expr"]))
    assert weights == {mapping["text"]: number for number, mapping in legend.items()}
    assert set(weights) == states


def test_the_dashboard_shows_every_metric(series: dict[str, set[str]]) -> None:
    queried = {name for query in QUERIES for name, _ in selected(query)}
    # The dashboard shows frames per component, and the clock curves end while the clock is not valid.
    # Whether anybody subscribes is for an alert.
    hidden = {
        "rtc3d_gateway_frames_received_total",
        "rtc3d_gateway_clock_valid",
        "rtc3d_gateway_source_subscribed",
    }
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
    assert [rule["alert"] for rule in ALERTS] == re.findall(r"^\| `([A-Z]\w+)` \|", OPERATIONS, re.MULTILINE)
    for rule in ALERTS:
        known = set().union(PROMETHEUS_LABELS, *(series[name] for name, _ in selected(rule["expr"])))
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= known, rule["alert"]


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


# A running gateway ---------------------------------------------------------------------------


async def test_health_depends_on_the_servers_state() -> None:
    async with simulator() as server:
        port = server.port
    async with running_lab(port) as lab:
        await lab.until_all(lambda status: status.last_error)
        status, body = await lab.health()
        assert (status, body["healthy"]) == (503, False)
        assert [each["stream"] for each in body["streams"]] == ["3d 6d", "analog"]
        assert all(f"refused by 127.0.0.1:{port}" in each["problem"] for each in body["streams"])
        async with simulator(port) as server:
            await lab.streaming()
            assert (await lab.health())[0] == 200
            server.stop_measurement()
            await lab.until_all(lambda status: status.state is StreamState.NO_MEASUREMENT)
            assert (await lab.health())[0] == 200


async def test_a_port_in_use_is_logged_once_and_the_gateway_runs(caplog: pytest.LogCaptureFixture) -> None:
    async with simulator() as server, running_lab(server.port) as first:
        caplog.clear()
        async with running_lab(server.port, first.port) as second:
            await second.streaming()
        [warning] = [record for record in caplog.records if record.name == "gateway.monitoring.server"]
    assert warning.levelno == logging.WARNING
    assert re.search(f"port {first.port}: .*metrics.port", warning.message)


async def test_frames_that_the_server_numbered_and_did_not_send_are_counted() -> None:
    numbers = (*range(1, 301), *range(351, 401))

    def answer(command: str) -> bytes:
        if command.startswith("SendParameters"):
            return packet(2, b"<RT_Parameters Ver='1.00'/>")
        is_stream = command.startswith("StreamFrames") and "Stop" not in command
        frames = (markers_frame(number, (0.0, 0.0, 0.0)) for number in numbers if is_stream)
        return ok(f"OK-{command}") + b"".join(frames)

    async with (
        ScriptedServer(lambda client: client.commands(answer)) as server,
        run_gateway(server.port) as gateway,
    ):
        await gateway.wait_until(gateway.status.losses.report)
        assert amounts(gateway.status.losses.report()) == {"not sent by the server": (50, 50)}
        assert json.loads(health_page(gateway.gateway).body)["status"] == "degraded"
        messages = await gateway.wait_for("3d", len(numbers))
        assert [message.sequence for message in messages] == list(range(len(numbers)))
