"""``make wheel`` and ``pipx install`` of the wheel, in otherwise empty folders."""

import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest

from gateway import __version__
from tests.support.fresh_clones import (
    COMPILED_MODULES,
    QUICK_CC,
    ROOT,
    SYSTEM_PYTHON,
    WHEELHOUSE_PYTHON,
    clone_into,
    files_in,
    pip_environment,
    skip_if_plain,
)

# The compiled modules take a minute on a busy machine; one worker builds them.
pytestmark = [pytest.mark.wheelhouse, pytest.mark.timeout(600)]

_PATH = "/usr/local/bin:/usr/bin:/bin"


class BuiltWheel(NamedTuple):
    """A wheel and the output of make."""

    path: Path
    make_output: str

    @property
    def names(self) -> set[str]:
        return set(zipfile.ZipFile(self.path).namelist())


def make_wheel(clone: Path, **environment: str) -> BuiltWheel:
    clone_into(clone)
    before = files_in(clone)
    make = ["make", "-C", str(clone), "wheel", f"PYTHON={WHEELHOUSE_PYTHON}"]
    output = subprocess.check_output(make, env={"PATH": _PATH, **pip_environment(), **environment}, text=True)
    [wheel] = clone.glob("dist/*.whl")
    assert files_in(clone) == before | {f"dist/{wheel.name}"}
    return BuiltWheel(wheel, output)


@pytest.fixture(scope="module")
def compiled_wheel(tmp_path_factory: pytest.TempPathFactory) -> BuiltWheel:
    """The wheel of this machine: compiled if there is a compiler."""
    return make_wheel(tmp_path_factory.mktemp("clone"), CC=QUICK_CC)


@pytest.fixture(scope="module")
def plain_wheel(tmp_path_factory: pytest.TempPathFactory) -> BuiltWheel:
    """The wheel of a machine without a compiler."""
    return make_wheel(tmp_path_factory.mktemp("clone"), CC="no-such-compiler")


@pytest.fixture(scope="module")
def program(compiled_wheel: BuiltWheel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("home")
    folders = {f"PIPX_{name}": str(home / name) for name in ("HOME", "BIN_DIR", "MAN_DIR")}
    environment = {"PATH": _PATH, "HOME": str(home), **folders, **pip_environment()}
    pipx = [
        sys.executable,
        "-m",
        "pipx",
        "install",
        "--quiet",
        f"--python={SYSTEM_PYTHON}",
        str(compiled_wheel.path),
    ]
    subprocess.run(pipx, env=environment, check=True)
    return home / "BIN_DIR" / "rtc3d-gateway"


def run(program: Path, folder: Path, *arguments: str) -> str:
    """Run the program outside the repository, and return its output."""
    command = [str(program), *arguments]
    return subprocess.check_output(command, cwd=folder, env={"PATH": _PATH, "LANG": "C.UTF-8"}, text=True)


@pytest.mark.parametrize("kind", ["compiled_wheel", "plain_wheel"])
def test_the_wheel_contains_message_types_and_configurations(
    kind: str, request: pytest.FixtureRequest
) -> None:
    names = request.getfixturevalue(kind).names
    message_types = {f"rtc3d/{path.name}" for path in (ROOT / "lcm_types/rtc3d").glob("*.lcm")}
    vectors = {f"rtc3d/vectors/{name}" for name in files_in(ROOT / "lcm_types/vectors")}
    configurations = {f"gateway/_config/{name}" for name in files_in(ROOT / "config")}
    assert message_types | vectors | configurations | {"gateway/py.typed"} | set(COMPILED_MODULES) <= names
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)


def test_with_a_compiler_the_wheel_is_compiled_for_this_platform(compiled_wheel: BuiltWheel) -> None:
    skip_if_plain(compiled_wheel.make_output)
    compiled = {
        name.partition(".")[0] + ".py"
        for name in compiled_wheel.names
        if name.endswith(".so") and "/" in name
    }
    assert compiled == set(COMPILED_MODULES)
    assert compiled_wheel.path.name.endswith(f"{sysconfig.get_platform().replace('-', '_')}.whl")


def test_without_a_compiler_the_wheel_is_for_any_platform_and_make_reports_what_is_missing(
    plain_wheel: BuiltWheel,
) -> None:
    assert not any(name.endswith(".so") for name in plain_wheel.names)
    assert plain_wheel.path.name.endswith("-py3-none-any.whl")
    [line] = [line for line in plain_wheel.make_output.splitlines() if "Not compiled" in line]
    assert "missing: no-such-compiler (Debian: apt-get install gcc python3-dev)" in line


def test_the_program_prints_its_version_and_that_it_is_compiled(
    compiled_wheel: BuiltWheel, program: Path, tmp_path: Path
) -> None:
    skip_if_plain(compiled_wheel.make_output)
    assert run(program, tmp_path, "--version") == f"rtc3d-gateway {__version__} (compiled)\n"


@pytest.mark.parametrize("name", ["gateway.yaml", "demo.yaml", "two-servers.yaml"])
def test_the_program_checks_a_configuration(program: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes((ROOT / "config" / name).read_bytes())
    assert "valid" in run(program, tmp_path, "check", name)


def test_the_program_runs_the_demo(program: Path, tmp_path: Path) -> None:
    assert "Nothing was lost." in run(program, tmp_path, "demo", "--seconds", "1")
