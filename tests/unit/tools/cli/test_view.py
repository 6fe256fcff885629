"""``rtc3d-gateway view`` before it serves a page: what it says if it cannot."""

import shlex
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gateway.tools.cli import view as view_command
from gateway.tools.cli.view import VISER
from tests.support.errors import names

PROJECT = Path(__file__).parents[4] / "pyproject.toml"
WITHOUT_VISER = "import sys; sys.modules['viser'] = None; from gateway.tools.cli.main import main; main()"


def view(*arguments: str, program: tuple[str, ...] = ("-m", "gateway")) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *program, "view", "--no-browser", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_without_viser_one_sentence_has_the_commands_that_install_it() -> None:
    run = view(program=("-c", WITHOUT_VISER))
    assert (run.returncode, run.stdout) == (1, "")
    [line] = run.stderr.splitlines()
    assert names(line, "'rtc3d-gateway[view]'")
    assert f"{shlex.quote(sys.executable)} -m pip install '{VISER}'" in line


def test_the_command_installs_what_the_extra_has() -> None:
    extras = tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]
    assert extras["view"] == [VISER]


def test_a_port_in_use_is_one_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        run = view("--port", str(port))
    assert (run.returncode, run.stdout) == (1, "")
    [line] = run.stderr.splitlines()
    assert names(line, port, "127.0.0.1")


def test_a_source_that_the_take_does_not_have_is_one_sentence_and_no_page() -> None:
    run = view("examples/walk.lcmlog", "--port", "0", "--source", "nosuch")
    assert (run.returncode, run.stdout) == (2, "")
    [line] = run.stderr.splitlines()
    assert names(line, "examples/walk.lcmlog", "'nosuch'", "lab")


def test_a_browser_is_opened_only_where_it_has_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert not view_command._has_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert view_command._has_display()
