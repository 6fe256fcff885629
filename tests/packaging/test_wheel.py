"""``make wheel``, and what ``pipx install`` makes of it, in folders that have nothing else."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.clones import ROOT, SYSTEM_PYTHON, clone_into, files_in, pip_environment

pytestmark = [pytest.mark.wheelhouse]

_PATH = "/usr/local/bin:/usr/bin:/bin"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    clone = tmp_path_factory.mktemp("clone")
    clone_into(clone)
    before = files_in(clone)
    make = ["make", "-C", str(clone), "wheel", f"PYTHON={sys.executable}"]
    subprocess.run(make, env={"PATH": _PATH, **pip_environment()}, check=True, stdout=subprocess.DEVNULL)
    [built] = clone.glob("dist/*.whl")
    assert files_in(clone) == before | {f"dist/{built.name}"}
    return built


@pytest.fixture(scope="module")
def program(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("home")
    folders = {f"PIPX_{name}": str(home / name) for name in ("HOME", "BIN_DIR", "MAN_DIR")}
    environment = {"PATH": _PATH, "HOME": str(home), **folders, **pip_environment()}
    pipx = [sys.executable, "-m", "pipx", "install", "--quiet", f"--python={SYSTEM_PYTHON}", str(wheel)]
    subprocess.run(pipx, env=environment, check=True)
    return home / "BIN_DIR" / "rtc3d-gateway"


def run(program: Path, folder: Path, *arguments: str) -> str:
    """Run the program where nothing of the repository is, and return what it prints."""
    command = [str(program), *arguments]
    return subprocess.check_output(command, cwd=folder, env={"PATH": _PATH, "LANG": "C.UTF-8"}, text=True)


def test_the_wheel_has_message_types_and_configurations(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    message_types = {f"rtc3d/{path.name}" for path in (ROOT / "lcm_types/rtc3d").glob("*.lcm")}
    configurations = {f"gateway/_config/{name}" for name in files_in(ROOT / "config")}
    assert message_types | configurations | {"gateway/py.typed"} <= names
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)


def test_the_program_says_its_version(program: Path, tmp_path: Path) -> None:
    assert run(program, tmp_path, "--version").startswith("rtc3d-gateway ")


@pytest.mark.parametrize("name", ["gateway.yaml", "demo.yaml", "two-servers.yaml"])
def test_the_program_checks_a_configuration(program: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes((ROOT / "config" / name).read_bytes())
    assert "good" in run(program, tmp_path, "check", name)


def test_the_program_runs_the_demo(program: Path, tmp_path: Path) -> None:
    assert "Nothing was lost." in run(program, tmp_path, "demo", "--seconds", "1")
