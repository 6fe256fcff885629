from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gateway.cli.config import configuration
from gateway.cli.main import app
from gateway.config.schema import schema_text
from gateway.errors import ConfigError

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
def test_a_server_is_a_configuration(server: str, host: str, port: int) -> None:
    [source] = configuration(None, server).settings.sources
    assert (source.name, source.host, source.port) == ("lab", host, port)


@pytest.mark.parametrize("server", ["lab:0", "lab:x", "lab:65536", "[::1]:70000"])
def test_a_port_is_a_number_in_range(server: str) -> None:
    with pytest.raises(typer.BadParameter, match="the port is a number from 1 to 65535"):
        configuration(None, server)


def test_a_server_and_a_file_are_one_too_many() -> None:
    with pytest.raises(typer.BadParameter, match="either --config FILE or --server"):
        configuration(DEMO, "lab")


def test_nothing_at_all_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="either --config FILE or --server"):
        configuration(None, None)


def test_the_environment_alone_is_a_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SOURCES, "[{name: lab, host: lab-pc}]")
    assert configuration(None, None).settings.sources[0].host == "lab-pc"


def test_the_environment_stands_over_both(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    assert configuration(DEMO, None).settings.lcm.prefix == "HALL2"
    assert configuration(None, "lab").settings.lcm.prefix == "HALL2"


def test_show_prints_values_and_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    lines = [" ".join(line.split()) for line in printed("config", "show", "--config", str(DEMO)).splitlines()]
    assert f"host: 127.0.0.1 # {DEMO}:9" in lines
    assert "prefix: HALL2 # RTC3D_GATEWAY__LCM__PREFIX" in lines
    assert "- name: lab # --server" in " ".join(printed("config", "show", "--server", "lab-pc").split())


def test_schema_prints_the_schema() -> None:
    assert printed("config", "schema") == schema_text()


def test_check_counts_the_environment_in(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "good; 1 source(s): lab" in printed("check", str(DEMO))
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIXX", "HALL2")
    with pytest.raises(ConfigError, match=r"RTC3D_GATEWAY__LCM__PREFIXX: lcm\.prefixx: unknown key"):
        printed("check", str(DEMO))
