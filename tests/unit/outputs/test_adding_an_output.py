"""Adding an output takes one module and one line in the registry: everything else finds it there."""

import asyncio
import dataclasses
import io
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from typer.testing import CliRunner

from gateway.config import loading
from gateway.config.settings import Settings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.metrics import GatewayMetrics
from gateway.daemon.monitoring.process_limits import DiskFacts, LoopDelay
from gateway.daemon.monitoring.server import health_page
from gateway.errors import ConfigError
from gateway.messages.decode import decode
from gateway.outputs.contract import OutputHealth
from gateway.outputs.findings import Result
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.registry import OUTPUTS, settings_type
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.tools.cli.demo_lab import run_demo
from gateway.tools.cli.main import app
from gateway.tools.doctor.all_checks import check_output, run_checks_without_settings
from tests.support.errors import names, raises
from tests.support.example_output import (
    EXAMPLE,
    UNREACHABLE,
    ExampleOutput,
    ExampleSettings,
    ExampleSubscription,
)
from tests.support.waiting import wait_until_async

OFF = {"zenoh": {"enabled": False}, "lcm": {"enabled": False}, "metrics": {"enabled": False}}


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = dict(OUTPUTS)
    monkeypatch.setitem(OUTPUTS, EXAMPLE.name, EXAMPLE)
    yield
    OUTPUTS.clear()  # monkeypatch would put back at the end what a test has removed
    OUTPUTS.update(before)


def scene() -> SyntheticScene:
    return SyntheticScene(markers=3, tools=1, analog=0, plates=0, rate_hz=100)


def written(folder: Path, port: int = 3020, **example: Any) -> Path:
    """Return a configuration file with one source, the example and no other output."""
    lab = {"name": "lab", "host": "127.0.0.1", "port": port}
    file = folder / "lab.yaml"
    file.write_text(json.dumps({"sources": [lab], "example": {"enabled": True} | example} | OFF))
    return file


def read(file: Path, **variables: str) -> Settings:
    return loading.read(file, settings_type(), variables).settings


def run_command(*arguments: str) -> str:
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


class Lab:
    """A running gateway of a simulator, and its only output."""

    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        [output] = gateway.outputs
        assert isinstance(output.output, ExampleOutput)
        self.output = output.output
        [self.source] = gateway.sources
        self.received: list[tuple[str, bytes]] = []

    def subscribe(self) -> ExampleSubscription:
        request = SubscriptionRequest("lab", None)
        return ExampleSubscription("local", request, lambda *message: self.received.append(message))

    async def messages(self, component: str, count: int = 1) -> list[bytes]:
        """Return the messages of one component, once there are ``count`` of them."""

        def found() -> list[bytes]:
            return [message for name, message in self.received if name == f"lab/{component}"]

        await wait_until_async(lambda: len(found()) >= count)
        return found()

    def metric(self, name: str, **labels: str) -> float:
        page = GatewayMetrics(self.gateway, LoopDelay(), DiskFacts(self.gateway)).page()
        [value] = [
            sample.value
            for family in text_string_to_metric_families(page.body.decode())
            for sample in family.samples
            if sample.name == f"rtc3d_gateway_{name}" and labels.items() <= sample.labels.items()
        ]
        return value


@asynccontextmanager
async def running(folder: Path) -> AsyncIterator[Lab]:
    async with Simulator(scene()) as simulator:
        gateway = Gateway(read(written(folder, simulator.port)))
        stop = asyncio.Event()
        task = asyncio.create_task(gateway.run(stop))
        try:
            yield Lab(gateway)
        finally:
            stop.set()
            await task


def test_yaml_and_environment_variables_configure_it(tmp_path: Path) -> None:
    file = written(tmp_path, address="from-file")
    for variables, address in (({}, "from-file"), ({"RTC3D_GATEWAY__EXAMPLE__ADDRESS": "other"}, "other")):
        assert read(file, **variables).outputs["example"] == ExampleSettings(enabled=True, address=address)


def test_a_mistake_in_its_section_is_reported_with_its_position(tmp_path: Path) -> None:
    with raises(ConfigError, "example.adress", "'address'"):
        read(written(tmp_path, adress="typo"))


def test_the_json_schema_describes_its_section() -> None:
    schema = json.loads(run_command("config", "schema"))
    assert "example" in schema["properties"]
    section = schema["$defs"]["ExampleSettings"]["properties"]
    assert section["address"] == {"default": "local", "description": "Where to publish.", "type": "string"}


def test_config_show_prints_its_values_with_their_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__EXAMPLE__WHOLE_FRAMES", "true")
    file = written(tmp_path, address="from-file")
    text = run_command("config", "show", "--config", str(file)).partition("\nexample:\n")[2]
    assert [" ".join(line.split()) for line in text.splitlines()[:3]] == [
        f"enabled: true # {file}:1",
        f"address: from-file # {file}:1",
        "whole_frames: true # RTC3D_GATEWAY__EXAMPLE__WHOLE_FRAMES",
    ]


class Broken(ExampleOutput):
    def __init__(self, settings: ExampleSettings) -> None:
        if settings.address == "refused":
            raise ConfigError("example.address is no address")
        super().__init__(settings)

    def health(self) -> OutputHealth:
        return OutputHealth(False, "it is broken") if self.settings.address == "broken" else super().health()


@pytest.mark.parametrize(
    ("settings", "result", "found", "remedy"),
    [
        ({"enabled": True}, Result.PASSING, "", ""),
        ({"enabled": False}, Result.NOT_TESTED, "", ""),
        ({"address": UNREACHABLE}, Result.FAILING, "nothing answers at", "Correct example.address."),
        ({"address": "broken"}, Result.FAILING, "it is broken", "Correct example in the configuration."),
        (
            {"address": "refused"},
            Result.FAILING,
            "example.address is",
            "Correct example in the configuration.",
        ),
    ],
    ids=["opens", "is disabled", "says why not", "names no remedy", "refuses its configuration"],
)
def test_the_doctor_checks_that_it_opens(
    settings: dict[str, Any], result: Result, found: str, remedy: str
) -> None:
    kind = dataclasses.replace(EXAMPLE, create=Broken)
    [finding] = check_output(kind, ExampleSettings(**({"enabled": True} | settings)), ["lab"], [], 0.0)
    assert (finding.subject, finding.check, finding.result) == ("example", "opens", result)
    assert finding.found.startswith(found)
    assert finding.remedy.startswith(remedy)


def test_the_doctor_lists_its_check_without_a_configuration() -> None:
    findings = list(run_checks_without_settings(ConfigError("lab.yaml: broken")))
    assert ("example", "opens") in [(finding.subject, finding.check) for finding in findings]


async def test_echo_prints_its_messages(tmp_path: Path) -> None:
    async with running(tmp_path):
        command = ("echo", "--output", "example", "--component", "3d", "--count", "3", "--json")
        text = await asyncio.to_thread(run_command, *command)
    messages = [json.loads(line) for line in text.splitlines()]
    assert [message["key"] for message in messages] == ["lab/3d"] * 3
    assert messages[0]["num_markers"] == 3


def test_echo_lists_it_among_the_outputs_to_choose_from() -> None:
    result = CliRunner().invoke(app, ["echo", "--output", "nosuch"], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert names(result.output, "zenoh, lcm, example")


async def test_the_demo_shows_it_and_counts_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(OUTPUTS, "zenoh")
    monkeypatch.delitem(OUTPUTS, "lcm")
    out = io.StringIO()
    assert await run_demo(scene(), asyncio.Event(), Console(file=out, width=200), seconds=0.2)
    assert "example" in out.getvalue()


async def test_it_receives_components_status_and_clock(tmp_path: Path) -> None:
    async with running(tmp_path) as lab:
        with closing(lab.subscribe()):
            markers = [decode(message) for message in await lab.messages("3d", 5)]
            await lab.messages("6d")
            status = decode((await lab.messages("status"))[0])
            await lab.messages("clock")
            assert lab.output.num_maintained > 0
        sequences = [message.sequence for message in markers]
        assert sequences == list(range(sequences[0], sequences[0] + len(markers)))
        assert [(output.name, bool(output.connected)) for output in status.outputs] == [("example", True)]
    assert not lab.output.is_open


async def test_the_metrics_and_the_health_check_show_it(tmp_path: Path) -> None:
    async with running(tmp_path) as lab:
        await wait_until_async(lambda: lab.metric("messages_total", output="example", component="3d") > 0)
        assert lab.metric("message_bytes_total", output="example", component="3d") > 0
        assert lab.metric("output_connected", output="example") == 1
        assert lab.metric("output_drops_total", output="example", cause="not open") == 0
        assert lab.metric("output_drops_total", output="example", cause="request of lab ignored") == 1
        await wait_until_async(lambda: lab.source.streams[0].session)
        assert b"<The_3D>" in (await lab.output.query("lab/parameters")).payload
        assert lab.metric("queries_total", output="example", result="ok") == 1
        assert json.loads(health_page(lab.gateway).body)["outputs"] == [{"output": "example", "problem": ""}]
