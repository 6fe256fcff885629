import gc
import json
import logging
import signal
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gateway.client import GatewayAddress
from gateway.config.loading import Configuration, schema_text
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from gateway.tools.cli import config
from gateway.tools.cli.config import configuration_from_options
from gateway.tools.cli.main import app
from gateway.tools.cli.options import QueryOptions
from tests.support.commands import run_in_process
from tests.support.configurations import MODEL
from tests.support.errors import names, raises
from tests.support.records import logged


@pytest.fixture(autouse=True)
def default_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of the default configuration, which does not exist."""
    path = tmp_path / "default.yaml"
    monkeypatch.setattr(config, "DEFAULT_CONFIG", path)
    return path


@pytest.fixture(autouse=True)
def _process_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep run and simulate from changing the process of the tests."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(gc, "freeze", lambda: None)
    monkeypatch.setattr(sys, "setswitchinterval", lambda _seconds: None)


DEMO = Path(__file__).parents[4] / "config/demo.yaml"


def printed(*arguments: str) -> str:
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.parametrize(
    ("server", "host", "port"),
    [
        ("lab-pc", "lab-pc", 3020),
        ("192.0.2.20:3030", "192.0.2.20", 3030),
        ("::1", "::1", 3020),
        ("[::1]", "::1", 3020),
        ("[::1]:3030", "::1", 3030),
    ],
)
def test_server_option_is_a_configuration(server: str, host: str, port: int) -> None:
    [source] = configuration_from_options(None, server).settings.sources
    assert (source.name, source.host, source.port) == ("lab", host, port)


@pytest.mark.parametrize("host", ["a..b", "x" * 64, "lab\0", "127.1"])
@pytest.mark.parametrize("command", [("simulate", "--host"), ("run", "--server")])
def test_a_host_that_cannot_be_looked_up_is_an_error(command: tuple[str, str], host: str) -> None:
    result = CliRunner().invoke(app, [*command, host])
    assert result.exit_code == 2 or isinstance(result.exception, ConfigError)
    assert names(result.output or str(result.exception), "host")


@pytest.mark.parametrize("server", ["lab:0", "lab:x", "lab:65536", "[::1]:70000"])
def test_port_must_be_a_number_in_range(server: str) -> None:
    with raises(typer.BadParameter, 1, 65535):
        configuration_from_options(None, server)


def test_config_and_server_exclude_each_other_and_one_is_needed(default_config: Path) -> None:
    with raises(typer.BadParameter, "--config", "--server"):
        configuration_from_options(DEMO, "lab")
    with pytest.raises(typer.BadParameter) as raised:
        configuration_from_options(None, None)
    assert names(str(raised.value), "--config", "--server", default_config)


@pytest.mark.parametrize("command", ["run", "doctor", "config show", "config check"])
def test_commands_without_a_configuration_end_with_status_2(command: str) -> None:
    result = CliRunner().invoke(app, command.split(), env={"COLUMNS": "300"})
    assert result.exit_code == 2
    wanted = ["FILE"] if command == "config check" else ["--config FILE", "--server HOST[:PORT]"]
    assert names(result.output, *wanted)


def test_the_default_file_is_read_and_environment_variables_override_it(
    default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_config.write_text("sources: [{name: hall, host: 192.0.2.1}]\nlcm: {prefix: FILE}\n")
    assert prefix_of(configuration_from_options(None, None)) == "FILE"
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    assert prefix_of(configuration_from_options(None, None)) == "HALL2"
    assert configuration_from_options(None, "lab").settings.sources[0].host == "lab"
    assert f"# {default_config}:1" in printed("config", "show")
    assert names(printed("config", "check"), default_config, 1, "hall")


@pytest.mark.parametrize("command", ["record walk", "view", "top", "list", "take list"])
@pytest.mark.parametrize(
    ("options", "values"),
    [
        ("--lcm --connect tcp/127.0.0.1:1", ["--connect", "--zenoh-config", "Zenoh"]),
        ("--lcm --zenoh-config viewer.json5", ["--connect", "--zenoh-config", "Zenoh"]),
        ("--url memq://", ["--url", "--lcm"]),
    ],
)
def test_options_for_another_transport_end_with_status_2(
    command: str, options: str, values: list[str]
) -> None:
    result = CliRunner().invoke(app, f"{command} {options}".split(), env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert names(result.output, *values)


def test_all_options_of_an_address_reach_the_client() -> None:
    """A command that ignored one would ask another gateway than the user named."""
    options = QueryOptions("tcp/127.0.0.1:1", Path("viewer.json5"), "memq://1", "memq://2", "HALL", 1.0)
    assert options.address(lcm=True) == GatewayAddress(
        is_lcm=True,
        connect="tcp/127.0.0.1:1",
        zenoh_config=Path("viewer.json5"),
        url="memq://1",
        queries_url="memq://2",
        prefix="HALL",
    )


def test_doctor_reads_the_default_file(default_config: Path) -> None:
    default_config.write_text("sources: [{name: lab, host: a..b}]\n")
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "".join(str(default_config).split()) in "".join(result.output.split())  # it wraps long lines


def test_run_reads_the_default_file_and_says_so(
    default_config: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    default_config.write_text("sources: [{name: lab, host: a..b}]\n")
    result = CliRunner().invoke(app, ["run"])
    assert isinstance(result.exception, ConfigError)
    assert str(default_config) in str(result.exception)
    assert [(each.level, each.args) for each in logged(caplog, logging.INFO)] == [("INFO", (default_config,))]


def test_check_takes_the_file_as_argument_or_option_and_can_be_quiet(tmp_path: Path) -> None:
    assert printed("config", "check", "-c", str(DEMO)) == printed("config", "check", str(DEMO))
    assert printed("config", "check", "-q", str(DEMO)) == ""
    twice = CliRunner().invoke(app, ["config", "check", str(DEMO), "-c", str(DEMO)])
    assert twice.exit_code == 2
    (tmp_path / "lab.yaml").write_text("sources: []")
    with pytest.raises(ConfigError, match=r"lab\.yaml:1:10"):
        printed("config", "check", "--quiet", str(tmp_path / "lab.yaml"))


def test_check_can_print_json(tmp_path: Path) -> None:
    content = json.loads(printed("config", "check", "--json", str(DEMO)))
    assert content == {"file": str(DEMO), "is_valid": True, "sources": ["lab"], "mistakes": []}
    (tmp_path / "lab.yaml").write_text("sources: [{name: lab}, {host: a}]")
    result = CliRunner().invoke(app, ["config", "check", "--json", str(tmp_path / "lab.yaml")])
    content = json.loads(result.output)
    assert (result.exit_code, content["is_valid"], len(content["mistakes"])) == (2, False, 2)


@pytest.mark.parametrize(
    "command",
    [
        "export examples/walk.lcmlog out.c3d --from 5 --to 2",
        "doctor --server :",
        "doctor --server 127.0.0.1:99999",
        "doctor --zenoh-config /nowhere",
        "simulate --take /nowhere.lcmlog",
        "simulate --c3d /nowhere.c3d",
        "demo --c3d /nowhere.c3d",
        "take start ../x",
        "take save ../x",
        "take fetch ../x",
        "export examples/walk.lcmlog /nowhere/out.trc --source nosuch",
        "export examples/walk.lcmlog /nowhere/out.trc --from 100",
        "export examples/walk.lcmlog /nowhere/out.xyz",
        "replay examples/walk.lcmlog --lcm --url memq:// --source nosuch",
        "replay examples/walk.lcmlog --lcm --url memq:// --from 100",
        "simulate --port 0 --take examples/walk.lcmlog --source nosuch",
        "simulate --port 0 --take examples/walk.lcmlog --from 100",
        "record /nowhere/walk.c3d",
        "view examples/walk.lcmlog --prefix hall",
    ],
)
def test_a_wrong_value_of_an_option_has_the_status_2(command: str) -> None:
    """A script sees whether it made a mistake, or something failed, such as a full disk."""
    assert run_in_process(*command.split()).returncode == 2


@pytest.mark.parametrize("command", ["run -c /nowhere", "simulate --scenario /nowhere"])
def test_v_and_q_are_log_levels(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    levels: list[str] = []
    monkeypatch.setattr(logging, "basicConfig", lambda **settings: levels.append(settings["level"]))
    for options in ("", "-v", "--verbose", "-q", "--quiet", "--log-level error"):
        CliRunner().invoke(app, f"{command} {options}".split())
    assert levels == ["INFO", "DEBUG", "DEBUG", "WARNING", "WARNING", "ERROR"]


@pytest.mark.parametrize("options", ["-v -q", "-v --log-level error", "-q --log-level debug"])
@pytest.mark.parametrize("command", ["run", "simulate"])
def test_contradicting_log_levels_are_a_mistake(command: str, options: str) -> None:
    result = CliRunner().invoke(app, [command, *options.split()], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert names(result.output, "--log-level", "--verbose", "--quiet")


def test_environment_variables_are_a_configuration_and_override_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    assert prefix_of(configuration_from_options(DEMO, None)) == "HALL2"
    assert prefix_of(configuration_from_options(None, "lab")) == "HALL2"
    lines = [" ".join(line.split()) for line in printed("config", "show", "--config", str(DEMO)).splitlines()]
    assert f"host: 127.0.0.1 # {DEMO}:9" in lines
    assert "prefix: HALL2 # RTC3D_GATEWAY__LCM__PREFIX" in lines
    assert "- name: lab # --server" in " ".join(printed("config", "show", "--server", "lab-pc").split())
    monkeypatch.setenv("RTC3D_GATEWAY__SOURCES", "[{name: lab, host: lab-pc}]")
    assert configuration_from_options(None, None).settings.sources[0].host == "lab-pc"


def prefix_of(configuration: Configuration) -> str:
    lcm = configuration.settings.outputs["lcm"]
    assert isinstance(lcm, LcmSettings)
    return lcm.prefix


def test_schema_prints_the_schema() -> None:
    assert printed("config", "schema") == schema_text(MODEL)


def test_check_includes_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    assert names(printed("config", "check", str(DEMO)), DEMO, 1, "lab")
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIXX", "HALL2")
    with raises(ConfigError, "RTC3D_GATEWAY__LCM__PREFIXX", "lcm.prefixx"):
        printed("config", "check", str(DEMO))


@pytest.mark.parametrize("name", ["", "#", "$*", "/", "a b", "x\n\x1b[31m", "\udcff", "a" * 100_000])
@pytest.mark.parametrize("option", ["--source", "--prefix", "--component", "--connect", "--url"])
def test_odd_names_are_mistakes(option: str, name: str) -> None:
    result = CliRunner().invoke(app, ["echo", "--seconds", "0", option, name], catch_exceptions=False)
    assert result.exit_code == 2
    assert len(result.output) < 2000


@pytest.mark.parametrize("name", ["**", "a/b", "@", "*"])
@pytest.mark.parametrize("command", ["echo", "params"])
def test_a_key_expression_is_no_name_of_a_source(command: str, name: str) -> None:
    result = CliRunner().invoke(app, [command, "--source", name], catch_exceptions=False)
    assert result.exit_code == 2
    assert "letters" in result.output
