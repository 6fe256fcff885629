"""Completion by shells: what they offer, from where, and that nothing else is printed."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from click.shell_completion import split_arg_string
from typer.testing import CliRunner

from gateway.config import files
from gateway.takes.files.reader import SUFFIX
from gateway.tools.cli import completion
from gateway.tools.cli.completion import source_names
from gateway.tools.cli.main import COMPLETION_VARIABLE, app
from tests.support.gateway_process import PROGRAM
from tests.support.takes import description, write_take


@pytest.fixture(autouse=True)
def default_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of the default configuration, which does not exist."""
    path = tmp_path / "default.yaml"
    monkeypatch.setattr(completion, "DEFAULT_CONFIG", path)
    monkeypatch.setattr(completion, "SERVICE_STATE", tmp_path / "service")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
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


def test_sources_of_the_configuration_on_the_command_line_are_offered(
    tmp_path: Path, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_config.write_text("sources: [{name: lab, host: a}]")
    other = tmp_path / "other.yaml"
    other.write_text("sources: [{name: hall, host: b}]")
    assert offered("rtc3d-gateway doctor --subscriber --source ", monkeypatch) == ["lab"]
    words = shlex.join(["rtc3d-gateway", "doctor", "--config", str(other), "--source", ""])
    assert offered(words.removesuffix("''"), monkeypatch) == ["hall"]


def test_a_take_in_the_home_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_take(tmp_path / "walk.lcmlog", [description("hall")])
    assert offered("rtc3d-gateway replay ~/walk.lcmlog --source ", monkeypatch) == ["hall"]
    assert offered("rtc3d-gateway replay ~/w", monkeypatch) == ["~/walk.lcmlog"]


TAKE_ARGUMENTS = ["replay", "export", "view", "take info", "simulate --take"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working directory, with takes, other files, and folders with both."""
    folder = tmp_path / "work"
    for path in ("walk.lcmlog", "Run.LCMLOG", "walk.c3d", "walk.txt", ".hidden.lcmlog", "lab/jump.lcmlog"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).touch()
    (folder / "lab/saved.lcmlog").mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("command", TAKE_ARGUMENTS)
@pytest.mark.parametrize(
    ("typed", "paths"),
    [
        ("", "Run.LCMLOG lab/ walk.lcmlog"),
        ("w", "walk.lcmlog"),
        ("./wa", "./walk.lcmlog"),
        ("lab/", "lab/jump.lcmlog lab/saved.lcmlog/"),
        ("lab/j", "lab/jump.lcmlog"),
        (".h", ".hidden.lcmlog"),
        ("walk.t", ""),
        ("la", ""),
        ("lab/s", ""),
        ("nowhere/", ""),
        ("walk.lcmlog/", ""),
    ],
)
@pytest.mark.usefixtures("folder")
def test_takes_and_folders_are_offered(
    command: str, typed: str, paths: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where only folders fit, the shell completes them, because it writes no space after them."""
    assert offered(f"rtc3d-gateway {command} {typed}", monkeypatch) == paths.split()


@pytest.mark.parametrize("command", ["simulate", "demo"])
@pytest.mark.usefixtures("folder")
def test_c3d_files_are_offered(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert offered(f"rtc3d-gateway {command} --c3d ", monkeypatch) == ["lab/", "walk.c3d"]


@pytest.mark.parametrize(
    "name", ["my take", "a*", "$(touch x)", "a'b", "`x`", "a;b", "a\nb", "a=b", "-x", "a\udcffb", "a&"]
)
def test_the_shell_completes_paths_that_it_must_quote(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / f"{name}.lcmlog").touch()
    assert offered("rtc3d-gateway replay ", monkeypatch) == []
    assert offered("rtc3d-gateway replay wa", monkeypatch) == ["walk.lcmlog"]


@pytest.fixture
def takes(tmp_path: Path, default_config: Path) -> Path:
    """Return the folder of takes of the default configuration, which has takes of two sources."""
    takes = tmp_path / "takes"
    for path in ("lab/walk.lcmlog", "lab/walk.c3d", "lab/a b.lcmlog", "hall/run-2.lcmlog", "x.lcmlog"):
        (takes / path).parent.mkdir(parents=True, exist_ok=True)
        (takes / path).touch()
    (takes / "hall/saved").mkdir()
    default_config.write_text(f"takes: {{directory: '{takes}'}}")
    return takes


@pytest.mark.usefixtures("takes")
def test_takes_of_the_configured_folder_are_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    assert offered("rtc3d-gateway take fetch ", monkeypatch) == ["run-2", "saved", "walk"]
    assert offered("rtc3d-gateway take fetch s", monkeypatch) == ["saved"]
    assert offered("rtc3d-gateway take fetch --source lab ", monkeypatch) == ["walk"]
    assert offered("rtc3d-gateway take fetch --source nowhere ", monkeypatch) == []
    assert offered("rtc3d-gateway take start ", monkeypatch) == [], "a new take has a new name"


@pytest.mark.parametrize("state", ["home/rtc3d-gateway", "service"])
def test_takes_of_the_usual_folders_are_offered(
    state: str, takes: Path, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a gateway of the user, and that of the service."""
    default_config.write_text("takes: {enabled: true}")
    (takes.parent / state).mkdir(parents=True)
    takes.rename(takes.parent / state / "takes")
    assert offered("rtc3d-gateway take fetch w", monkeypatch) == ["walk"]
    default_config.unlink()
    assert offered("rtc3d-gateway take fetch w", monkeypatch) == ["walk"]


@pytest.mark.parametrize(
    "content", ["takes: 3", "takes: {directory: 3}", "- a", "takes: {directory: /nowhere}"]
)
def test_a_bad_folder_of_takes_offers_nothing(
    content: str, default_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_config.write_text(content)
    assert offered("rtc3d-gateway take fetch ", monkeypatch) == []


WITHOUT_NETWORK = """
import sys

sys.modules |= dict.fromkeys(["zenoh", "lcm", "numpy", "asyncio", "pydantic"])  # imports fail
from gateway.tools.cli import completion
from gateway.tools.cli.main import main

completion.DEFAULT_CONFIG = completion.Path(sys.argv.pop())
main()
"""


@pytest.mark.usefixtures("folder", "takes")
@pytest.mark.parametrize("line", ["take fetch w", "take info w", "view w"])
def test_nothing_that_uses_the_network_or_takes_long_is_imported(line: str, default_config: Path) -> None:
    words = {"COMP_WORDS": f"rtc3d-gateway {line}", "COMP_CWORD": str(len(line.split()))}
    environ = {**os.environ, COMPLETION_VARIABLE: "complete_bash", **words}
    command = (sys.executable, "-c", WITHOUT_NETWORK, str(default_config))
    run = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    assert (run.stdout.strip().removesuffix(".lcmlog"), run.stderr) == ("walk", "")


def test_constants_are_those_of_the_reader_and_of_the_service() -> None:
    """Their modules take long to import, or are no Python."""
    assert completion._TAKE_SUFFIX == SUFFIX
    unit = Path(__file__).parents[4] / "systemd/rtc3d-gateway.service"
    assert f"StateDirectory={files.SERVICE_STATE.relative_to('/var/lib')}\n" in unit.read_text()


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
