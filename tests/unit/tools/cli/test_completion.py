"""Completion by shells: what they offer, from where, and that nothing else is printed."""

import os
import shlex
import subprocess
from pathlib import Path

import pytest
import typer
from click.shell_completion import split_arg_string
from typer.testing import CliRunner

from gateway.tools.cli import options
from gateway.tools.cli.main import COMPLETION_VARIABLE, app
from gateway.tools.cli.options import source_names
from tests.support.gateway_process import PROGRAM
from tests.support.takes import description, write_take


@pytest.fixture(autouse=True)
def default_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of the default configuration, which does not exist."""
    path = tmp_path / "default.yaml"
    monkeypatch.setattr(options, "DEFAULT_CONFIG", path)
    return path


def offered(line: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what is offered in bash for the last word of a line, which may be empty."""
    words = split_arg_string(line) + [""] * line.endswith(" ")
    monkeypatch.setenv(COMPLETION_VARIABLE, "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    result = CliRunner().invoke(app, [], prog_name="rtc3d-gateway")
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout.split()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ech", "echo"),
        ("take st", "start stop"),
        ("run --ser", "--server"),
        ("params 3d a", "analog"),
        *(
            (f"{command} --component e", "event")
            for command in ("echo", "record x.lcmlog", "replay x.lcmlog")
        ),
        ("--version take sto", "stop"),
        ("-h take sto", "stop"),
        ("take -h sto", "stop"),
        ("simulate --list-faults --por", "--port"),
        ("run --nosuch ", ""),
        ("echo --port 'a", ""),
    ],
)
def test_commands_options_and_values_are_offered(
    line: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Options that print something print nothing, and a wrong line offers nothing."""
    assert offered(f"rtc3d-gateway {line}", monkeypatch) == words.split()


def test_hidden_commands_are_not_offered_and_all_components_are(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "check" not in offered("rtc3d-gateway ", monkeypatch)
    assert set(offered("rtc3d-gateway echo --component ", monkeypatch)) >= {"3d", "6d", "status"}


@pytest.mark.parametrize(
    "command", ["echo", "params", "record new.lcmlog", "take start", "take fetch walk", "simulate --port 0"]
)
def test_sources_of_the_default_configuration_are_offered(
    command: str, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert offered(f"rtc3d-gateway {command} --source ", monkeypatch) == []
    default_config.write_text("sources: [{name: lab, host: a}, {name: hall, host: b}]")
    assert offered(f"rtc3d-gateway {command} --source ", monkeypatch) == ["lab", "hall"]
    assert offered(f"rtc3d-gateway {command} --source h", monkeypatch) == ["hall"]
    monkeypatch.setenv("RTC3D_GATEWAY__SOURCES__1__NAME", "house")
    assert offered(f"rtc3d-gateway {command} --source h", monkeypatch) == ["house"]


@pytest.mark.parametrize("command", ["replay {}", "export {} walk.c3d", "simulate --take {}"])
def test_sources_of_the_take_on_the_command_line_are_offered(
    command: str, tmp_path: Path, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_config.write_text("sources: [{name: lab, host: a}]")
    take = write_take(tmp_path / "take.lcmlog", [description("hall"), description("attic")])
    line = f"rtc3d-gateway {command.format(shlex.quote(str(take)))} --source "
    assert sorted(offered(line, monkeypatch)) == ["attic", "hall"]


HOSTILE = b"sources: [{name: '$(touch x)', host: a}, {name: \"a'b\", host: b}]"


@pytest.mark.parametrize(
    "content",
    [HOSTILE, b"sources: [{host: a}]", b"sources: 3", b"sources: [", b"- a", b"", b"\xff", b"x" * 1_000_000],
    ids=range(8),
)
def test_a_bad_configuration_offers_nothing(
    content: bytes, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_config.write_bytes(content)
    assert offered("rtc3d-gateway echo --source ", monkeypatch) == []


@pytest.mark.parametrize("content", [b"", b"no take", b"\0" * 1000])
def test_a_bad_take_offers_nothing(content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = tmp_path / "take.lcmlog"
    take.write_bytes(content)
    for path in (take, tmp_path):
        assert offered(f"rtc3d-gateway replay {shlex.quote(str(path))} --source ", monkeypatch) == []


def test_source_names_need_no_take_and_no_configuration() -> None:
    command = typer.main.get_command(app)
    assert source_names(typer.Context(command), "") == []


@pytest.mark.parametrize("variables", [{}, {"COMP_WORDS": "x"}, {"COMP_WORDS": "x", "COMP_CWORD": "y"}])
def test_without_the_variables_of_a_shell_it_fails_silently(variables: dict[str, str]) -> None:
    environ = {**os.environ, COMPLETION_VARIABLE: "complete_bash", **variables}
    run = subprocess.run(PROGRAM, env=environ, capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("", "")


SCRIPT = """
PATH=$1:$PATH
source <(_RTC3D_GATEWAY_COMPLETE=source_bash rtc3d-gateway)
COMP_WORDS=(rtc3d-gateway echo --component a)
COMP_CWORD=3
_rtc3d_gateway_completion rtc3d-gateway
echo "${COMPREPLY[@]}"
"""


def test_bash_completes_with_the_script_that_the_program_prints(tmp_path: Path) -> None:
    program = tmp_path / "rtc3d-gateway"
    program.write_text(f'#!/bin/sh\nexec {shlex.join(PROGRAM)} "$@"\n')
    program.chmod(0o755)
    environ = {**os.environ, "COMP_TYPE": "9"}
    command = ("bash", "-c", SCRIPT, "bash", str(tmp_path))
    run = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("analog\n", "")
