"""Scenario files, and the command that plays them."""

import errno
import logging
import os
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from gateway.errors import ConfigError
from gateway.rtc3d.components import ComponentType
from gateway.simulator.faults import Cut, Delay, Restart
from gateway.simulator.simulator import (
    COMMON_PARAMETERS,
    KINDS,
    Scenario,
    describe_kinds,
    load_scenario,
    parameters_of,
)
from gateway.simulator.synthetic import SceneSettings
from gateway.tools.cli.main import app
from tests.support.errors import raises

ROOT = Path(__file__).parents[3]
SCENARIOS = sorted((ROOT / "config/scenarios").glob("*.yaml"))
REFERENCE = (ROOT / "docs/reference/simulator.md").read_text()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "scenario.yaml"


def test_a_scenario_has_a_scene_faults_and_a_seed(file: Path) -> None:
    file.write_text(
        """\
scene: {markers: 20, rate_hz: 200}
faults:
  - {fault: delay, delay_ms: 80, at_s: 5, for_s: 3}
  - {fault: cut, at_s: 10}              # mid-packet
  - {fault: restart, at_s: 15, away_s: 2, scene: {markers: 12}}
seed: 7
"""
    )
    restart = Restart(at_s=15, away_s=2, scene=SceneSettings(markers=12))
    faults = (Delay(delay_ms=80, at_s=5, for_s=3), Cut(at_s=10), restart)
    assert load_scenario(file) == Scenario(
        scene=SceneSettings(markers=20, rate_hz=200), faults=faults, seed=7
    )


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.name)
def test_every_shipped_scenario_loads(path: Path) -> None:
    assert load_scenario(path).faults


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("faults: [{fault: dely}]", "1:18: faults[0].fault: found 'dely'"),
        (
            "faults: [{delay_ms: 3}]",
            "1:10: faults[0]: found a mapping",
        ),
        (
            "faults: [{fault: cut, at: 3}]",
            "1:23: faults[0].at: unknown key",
        ),
        ("faults: [{fault: restart, scene: {marker: 3}}]", "1:35: faults[0].scene.marker: unknown key"),
        ("faults: delay", "1:9: faults: found 'delay'"),
        ("seed: 1", "1:1: faults: missing"),
        ("", "empty"),
    ],
)
def test_a_mistake_is_reported_with_its_place(file: Path, line: str, expected: str) -> None:
    file.write_text(line)
    with pytest.raises(ConfigError, match=rf"^{re.escape(f'{file}:')} ?{re.escape(expected)}"):
        load_scenario(file)
    file.unlink()
    with raises(ConfigError, os.strerror(errno.ENOENT), "config/scenarios/bad-day.yaml"):
        load_scenario(file)


# The scene ----------------------------------------------------------------------------------


def test_a_scene_has_the_sizes_rates_and_labels_of_its_settings() -> None:
    scene = SceneSettings(
        markers=3, tools=1, analog=2, plates=0, rate_hz=50, analog_rate_hz=500, marker_label="M"
    ).build()
    assert scene.rates_hz == {ComponentType.MARKERS: 50, ComponentType.TOOLS: 50, ComponentType.ANALOG: 500}
    assert scene.parameters.markers is not None
    assert [marker.label for marker in scene.parameters.markers.markers] == ["M 1", "M 2", "M 3"]


def test_only_the_values_that_are_set_change_a_scene() -> None:
    base = SceneSettings(markers=3, tools=1, rate_hz=50)
    # 24 markers are the default, but set here
    assert base.with_changes(SceneSettings(markers=24)) == SceneSettings(markers=24, tools=1, rate_hz=50)
    assert base.with_changes(SceneSettings()) == base


# The command line ---------------------------------------------------------------------------


def simulate(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["simulate", *arguments], env={"COLUMNS": "200"})


def test_faults_of_scenario_and_command_line_are_played(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    file.write_text("faults: [{fault: undersize, at_s: 0}]")
    faults = ("--fault", "cut", "--fault", "delay,delay_ms=3", "--seed", "3")
    result = simulate("--port", "0", "--seconds", "0.3", "--scenario", str(file), *faults)
    assert result.exit_code == 0, result.output
    logged = [message.split()[-1] for message in caplog.messages if message.startswith("Fault")]
    assert logged == ["undersize,at_s=0", "cut", "delay,delay_ms=3"]


def test_options_override_the_scenarios_scene() -> None:
    scenario = Scenario(scene=SceneSettings(markers=3, tools=1), faults=(Cut(),), seed=5)
    changed = scenario.with_overrides({"markers": 9, "rate_hz": 50.0}, [Delay()], None)
    scene = SceneSettings(markers=9, tools=1, rate_hz=50)
    assert changed == Scenario(scene=scene, faults=(Cut(), Delay()), seed=5)
    assert scenario.with_overrides({}, [], 0).seed == 0


def test_the_command_has_the_defaults_of_scenarios_and_lists_all_kinds_of_faults() -> None:
    help_text = simulate("--help").output
    for name, value in SceneSettings().model_dump(exclude={"seed", "marker_label"}).items():
        option = name.removesuffix("_hz").replace("_", "-")
        assert re.search(rf"--{option}\s.*\[default: {value}\]", help_text), name
    assert simulate("--list-faults").output == describe_kinds() + "\n"


# The reference ------------------------------------------------------------------------------


def test_the_reference_has_every_kind_with_its_parameters_and_defaults() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", REFERENCE, re.MULTILINE))
    assert set(KINDS) | set(COMMON_PARAMETERS) <= set(rows)
    for name, kind in KINDS.items():
        for parameter, default, _ in parameters_of(kind):
            assert f"`{parameter}`" in rows[name], f"{name}: {parameter}"
            assert default in rows[name], f"{name}: {parameter} is {default} by default"
        assert ("for_s" in rows[name]) == ("for_s" in kind.model_fields), name


def test_the_examples_of_the_reference_load(file: Path) -> None:
    examples = re.findall(r"^```yaml\n(.*?)^```$", REFERENCE, re.MULTILINE | re.DOTALL)
    assert examples
    for example in examples:
        file.write_text(example)
        assert load_scenario(file).faults
