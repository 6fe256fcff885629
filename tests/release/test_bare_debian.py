"""The wheels and the sdist on a Debian 12 with Python, without compiler and network."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.support.bare_debian import PYTHON_ROOT
from tests.support.errors import names
from tests.support.fresh_clones import ROOT, WHEELHOUSE_PYTHON, pip_environment
from tests.systemd.machine import CLONE, Machine, booted

pytestmark = [
    pytest.mark.systemd,
    pytest.mark.wheelhouse,
    pytest.mark.netns,
    pytest.mark.timeout(1800),
]

PIP: Final = f"{CLONE}/venv/bin/pip"
PROGRAM: Final = f"{CLONE}/venv/bin/rtc3d-gateway"
KINDS: Final = {"compiled": "(compiled)", "pure": "(pure Python)", "sdist": "(pure Python)"}


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def machine() -> Iterator[Machine]:
    with booted(PYTHON_ROOT) as machine:
        yield machine


def built(folder: Path, kind: str, repository: Path) -> Path:
    """Build a wheel or the sdist of a copy of the repository."""
    command = (str(WHEELHOUSE_PYTHON), "-B", "-m", "release.build", "--dist", str(folder), kind)
    environment = {**os.environ, **pip_environment()}
    subprocess.run(command, cwd=repository, env=environment, check=True)
    [path] = folder.iterdir()
    return path


@pytest.fixture
def previous(tmp_path: Path) -> Iterator[Path]:
    """Return a copy of the previous commit."""
    git = ("git", "-c", "safe.directory=*", "-C", str(ROOT))
    subprocess.run([*git, "worktree", "add", "--detach", tmp_path / "previous", "HEAD~1"], check=True)
    yield tmp_path / "previous"
    subprocess.run([*git, "worktree", "remove", "--force", tmp_path / "previous"], check=True)


async def install(machine: Machine, file: Path) -> None:
    """Install a file with pip, which finds what else it needs in the wheelhouse."""
    shutil.copy(file, machine.path(CLONE))
    offline = pip_environment(Path("/run/repository/build/wheelhouse"))
    options = ("install", "--quiet", "--upgrade", "--force-reinstall")
    await machine.run(PIP, *options, f"{CLONE}/{file.name}", environment=offline)


async def test_it_is_installed_runs_is_upgraded_and_removed(
    machine: Machine, kind: str, previous: Path, tmp_path: Path
) -> None:
    assert (await machine.run("sh", "-c", "command -v gcc cc make git", check=False)).text == ""
    machine.path(CLONE).mkdir()
    await machine.run("python3", "-m", "venv", f"{CLONE}/venv")
    before = {path.name for path in machine.path(f"{CLONE}/venv/bin").iterdir()}
    for folder, repository in (("older", previous), ("newer", ROOT)):
        await install(machine, built(tmp_path / folder, kind, repository))
        assert (await machine.run(PROGRAM, "--version")).text.endswith(f" {KINDS[kind]}\n")
        assert "Nothing was lost." in (await machine.run(PROGRAM, "demo", "--seconds", "1")).text
        machine.path("/tmp/lab.yaml").write_text("sources: [{name: lab, host: 192.0.2.20}]\n")
        checked = await machine.run(PROGRAM, "config", "check", "/tmp/lab.yaml")
        assert names(checked.text, "/tmp/lab.yaml", 1, "lab")
        doctor = await machine.run(PROGRAM, "doctor", "--server", "192.0.2.20", check=False)
        assert doctor.status == 1
        assert names(doctor.text, "192.0.2.20:3020")
    await machine.run(PIP, "uninstall", "--yes", "rtc3d-gateway")
    assert not machine.path(PROGRAM).exists()
    left = {path.name for path in machine.path(f"{CLONE}/venv/bin").iterdir()} - before
    assert not any("rtc3d" in name for name in left)
