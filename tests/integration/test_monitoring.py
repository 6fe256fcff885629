"""Monitoring of a running gateway: its metrics, and the dashboard and the alerts that use them."""

import asyncio
import json
import logging
import re
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
import uvloop
import yaml
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from gateway.config.settings import MetricsSettings, StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.components import ComponentType
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.configurations import local_source, make_settings
from tests.support.documents import ROOT
from tests.support.gateways import monitored_gateway
from tests.support.needs import need_programs
from tests.support.networks import free_port, zenoh_keys
from tests.support.waiting import wait_until_async

RULES: Final = ROOT / "config/prometheus/rtc3d-gateway.yaml"
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


def lab(server_port: int, port: int) -> Gateway:
    """Return a gateway for the source "lab" on Zenoh and LCM."""
    gateway = Gateway(
        make_settings(
            sources=(local_source(server_port, streams=STREAMS, stall_timeout_s=60.0),),
            zenoh=ZenohSettings(config=zenoh_keys("peer") | {"transport": TLS}),
            lcm=LcmSettings(url="memq://"),
            metrics=MetricsSettings(port=port),
        )
    )
    # Only for the metrics: the output itself publishes no status.
    takes = TakesSettings(enabled=True, directory="/tmp")
    gateway.settings = gateway.settings.model_copy(update={"takes": takes})
    return gateway


async def until_all(gateway: Gateway, condition: Callable[[StreamStatus], object]) -> None:
    await wait_until_async(lambda: all(condition(status) for status in gateway.sources[0].statuses))


def read_metrics(port: int) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=30) as page:
        text: str = page.read().decode()
    return text


def simulator() -> Simulator:
    scene = SyntheticScene(markers=2, tools=1, analog=2, plates=0, rate_hz=100, analog_rate_hz=200)
    return Simulator(scene)


@pytest.fixture(scope="module")
def families() -> dict[str, Metric]:
    """Return the metrics, by name, of a gateway that has streamed long enough for a valid clock."""

    async def run() -> dict[str, Metric]:
        port = free_port()
        async with simulator() as server, monitored_gateway(lab(server.port, port)) as gateway:
            await until_all(gateway, lambda status: status.clock.has_clock)
            outputs = gateway.sources[0].fan_out.outputs
            await wait_until_async(lambda: all(status.messages["status"] for _, status in outputs))
            page = ""
            while "certificate_not_after_timestamp_seconds{" not in page:  # read in a thread
                page = await asyncio.to_thread(read_metrics, port)
            return {family.name: family for family in text_string_to_metric_families(page)}

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
ALERTS = [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]


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
    assert all(line["logger"].startswith("gateway.session.server") for line in lines)


async def test_a_port_in_use_is_logged_once_and_the_gateway_runs(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        async with simulator() as server, monitored_gateway(lab(server.port, port)) as gateway:
            await until_all(gateway, lambda status: status.state is StreamState.STREAMING)
    [warning] = [record for record in caplog.records if record.name == "gateway.daemon.monitoring.server"]
    assert warning.levelno == logging.WARNING
    assert re.search(f"port {port}: .*metrics.port", warning.message)


# Alerts, with promtool ------------------------------------------------------------------------

_SOURCE: Final = 'instance="a",source="lab",stream="3d"'
_STREAMING: Final = {f'rtc3d_gateway_stream_state{{{_SOURCE},state="streaming"}}': "1+0x30"}
_DROPS: Final = 'instance="a",source="lab",cause="x"'

CASES: Final[list[tuple[str, str, str, str, bool]]] = [
    # alert, series, its values each minute if it fires, and if it does not, whether a stream is streaming
    ("GatewayDown", 'up{job="rtc3d-gateway",instance="a"}', "0+0x30", "1+0x30", False),
    ("OutputDown", 'rtc3d_gateway_output_connected{output="zenoh"}', "0+0x30", "1+0x30", False),
    ("TakesNotWritten", 'rtc3d_gateway_output_connected{output="takes"}', "0+0x30", "1+0x30", False),
    (
        "TakesNotWritten",
        f'rtc3d_gateway_output_drops_total{{{_DROPS},output="takes"}}',
        "0+1x30",
        "7+0x30",
        False,
    ),
    ("TakesDiskFilling", 'rtc3d_gateway_takes_free_bytes{instance="a"}', "1e9+0x30", "9e10+0x30", False),
    ("TakesDiskFilling", 'rtc3d_gateway_takes_free_bytes{instance="a"}', "9e10-1.7e9x30", "9e10+0x30", False),
    (
        "CertificateEnds",
        'rtc3d_gateway_certificate_not_after_timestamp_seconds{output="zenoh",key="connect_certificate"}',
        "2500000+0x30",
        "2700000+0x30",
        False,
    ),
    ("SourceSilent", f"rtc3d_gateway_last_frame_timestamp_seconds{{{_SOURCE}}}", "0+0x30", "0+60x30", True),
    ("ServerAway", f'rtc3d_gateway_stream_state{{{_SOURCE},state="idle"}}', "0+0x30", "1+0x30", False),
    ("ConnectionUnsteady", f"rtc3d_gateway_sessions_total{{{_SOURCE}}}", "0+1x30", "1+0x30", False),
    ("FramesDropped", f"rtc3d_gateway_stream_drops_total{{{_DROPS}}}", "0+1x30", "7+0x30", False),
    (
        "FramesDropped",
        f'rtc3d_gateway_output_drops_total{{{_DROPS},output="lcm"}}',
        "0+1x30",
        "7+0x30",
        False,
    ),
    ("FramesLate", f"rtc3d_gateway_lag_seconds{{{_SOURCE}}}", "0.1+0x30", "0.01+0x30", True),
    ("NoClock", f"rtc3d_gateway_clock_valid{{{_SOURCE}}}", "0+0x30", "1+0x30", True),
    ("EventLoopSlow", 'rtc3d_gateway_loop_delay_max_seconds{instance="a"}', "0.2+0x30", "0.01+0x30", False),
    ("NoSubscriber", 'rtc3d_gateway_source_subscribed{instance="a",source="lab"}', "0+0x30", "1+0x30", True),
    ("Defect", 'rtc3d_gateway_defects_total{instance="a"}', "0+1x30", "3+0x30", False),
    ("HostClockSet", 'rtc3d_gateway_host_clock_steps_total{instance="a"}', "0+1x30", "1+0x30", False),
]


def test_there_is_a_case_for_each_alert() -> None:
    assert {rule["alert"] for rule in ALERTS} == {alert for alert, *_ in CASES}


@pytest.mark.parametrize("does_fire", [True, False], ids=["fire", "do not fire"])
def test_alerts_fire_when_they_should_and_only_then(does_fire: bool, tmp_path: Path) -> None:
    """After 20 minutes with these values, one a minute."""
    need_programs("promtool", packages="prometheus")
    tests = []
    for alert, series, fires, rests, is_streaming in CASES:
        values = {series: fires if does_fire else rests} | (_STREAMING if is_streaming else {})
        query = {
            "expr": f'count(ALERTS{{alertname="{alert}",alertstate="firing"}})',
            "eval_time": "20m",
            "exp_samples": [{"labels": "{}", "value": 1}] if does_fire else [],
        }
        inputs = [{"series": name, "values": value} for name, value in values.items()]
        tests.append({"interval": "1m", "input_series": inputs, "promql_expr_test": [query]})
    file = tmp_path / "test.yaml"
    file.write_text(yaml.safe_dump({"rule_files": [str(RULES)], "tests": tests}))
    for command in (("check", "rules", str(RULES)), ("test", "rules", str(file))):
        done = subprocess.run(["promtool", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
