from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gateway.cli.configuration import configuration_from_options
from gateway.cli.main import app
from gateway.config.loading import Configuration
from gateway.config.schema import schema_text
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from tests.configurations import MODEL

SOURCES = "RTC3D_GATEWAY__SOURCES"
DEMO = Path(__file__).parents[3] / "config/demo.yaml"


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
    text = " ".join(result.output.replace("│", " ").split()) or str(result.exception)
    assert "expected a host name or an IP address" in text


@pytest.mark.parametrize("server", ["lab:0", "lab:x", "lab:65536", "[::1]:70000"])
def test_port_must_be_a_number_in_range(server: str) -> None:
    with pytest.raises(typer.BadParameter, match="the port must be a number from 1 to 65535"):
        configuration_from_options(None, server)


def test_config_and_server_exclude_each_other() -> None:
    with pytest.raises(typer.BadParameter, match="either --config FILE or --server"):
        configuration_from_options(DEMO, "lab")


def test_either_config_or_server_is_required() -> None:
    with pytest.raises(typer.BadParameter, match="either --config FILE or --server"):
        configuration_from_options(None, None)


def test_environment_variables_alone_are_a_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(SOURCES, "[{name: lab, host: lab-pc}]")
    assert configuration_from_options(None, None).settings.sources[0].host == "lab-pc"


def prefix_of(configuration: Configuration) -> str:
    lcm = configuration.settings.outputs["lcm"]
    assert isinstance(lcm, LcmSettings)
    return lcm.prefix


def test_environment_variables_override_config_and_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    assert prefix_of(configuration_from_options(DEMO, None)) == "HALL2"
    assert prefix_of(configuration_from_options(None, "lab")) == "HALL2"


def test_show_prints_values_and_origins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    lines = [" ".join(line.split()) for line in printed("config", "show", "--config", str(DEMO)).splitlines()]
    assert f"host: 127.0.0.1 # {DEMO}:9" in lines
    assert "prefix: HALL2 # RTC3D_GATEWAY__LCM__PREFIX" in lines
    assert "- name: lab # --server" in " ".join(printed("config", "show", "--server", "lab-pc").split())


def test_schema_prints_the_schema() -> None:
    assert printed("config", "schema") == schema_text(MODEL)


def test_check_includes_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "valid; 1 source: lab" in printed("config", "check", str(DEMO))
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIXX", "HALL2")
    with pytest.raises(ConfigError, match=r"RTC3D_GATEWAY__LCM__PREFIXX: lcm\.prefixx: unknown key"):
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
