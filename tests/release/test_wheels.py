"""The sdist and the wheels: built in otherwise empty folders, compared, and installed without a network."""

import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from gateway import __version__
from tests.support.builds import SYSTEM_PATH, Built, build, release
from tests.support.fresh_clones import (
    COMPILED_MODULES,
    ROOT,
    WHEELHOUSE_PYTHON,
    clone_into,
    files_in,
    pip_environment,
    skip_without_compiler,
)
from tests.support.needs import need

pytestmark = [pytest.mark.wheelhouse, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def program(compiled: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program as pipx installs it from the wheel of this machine."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = WHEELHOUSE_PYTHON.parents[1] / "lib" / version
    need(packages.exists(), f"installs from the wheelhouse, which is not for {version}")
    home = tmp_path_factory.mktemp("home")
    folders = {f"PIPX_{name}": str(home / name) for name in ("HOME", "BIN_DIR", "MAN_DIR")}
    environment = {"PATH": SYSTEM_PATH, "HOME": str(home), **folders, **pip_environment(), "PIP_COMPILE": "0"}
    pipx = [sys.executable, "-m", "pipx", "install", "--quiet", f"--python={sys.executable}"]
    subprocess.run([*pipx, str(compiled.wheel)], env=environment, check=True)
    return home / "BIN_DIR" / "rtc3d-gateway"


def run(program: Path, folder: Path, *arguments: str) -> str:
    """Run the program outside the repository, and return its output."""
    command = [str(program), *arguments]
    return subprocess.check_output(
        command, cwd=folder, env={"PATH": SYSTEM_PATH, "LANG": "C.UTF-8"}, text=True
    )


def test_the_same_sources_give_the_same_bytes(pure: Built, tmp_path: Path) -> None:
    """Whoever builds a commit can compare the result with what was published."""
    clone_into(tmp_path)
    for path in (tmp_path / name for name in files_in(tmp_path)):
        path.chmod(path.stat().st_mode & 0o700)
        os.utime(path, (10**9, 10**9))
    command = [str(WHEELHOUSE_PYTHON), "-B", "-m", "release.build", "sdist", "pure"]
    again = build(tmp_path, command, umask=0o077, TZ="Asia/Tokyo", HATCH_BUILD_HOOK_ENABLE_MYPYC="1")
    assert again.sdist.read_bytes() == pure.sdist.read_bytes()
    assert again.wheel.read_bytes() == pure.wheel.read_bytes()


@pytest.mark.parametrize("kind", ["compiled", "pure"])
def test_the_wheel_contains_message_types_and_configurations(
    kind: str, request: pytest.FixtureRequest
) -> None:
    names = request.getfixturevalue(kind).names_in_wheel
    message_types = {f"rtc3d/{path.name}" for path in (ROOT / "lcm_types/rtc3d").glob("*.lcm")}
    vectors = {f"rtc3d/vectors/{name}" for name in files_in(ROOT / "lcm_types/vectors")}
    configurations = {f"gateway/_config/{name}" for name in files_in(ROOT / "config")}
    assert message_types | vectors | configurations | {"gateway/py.typed"} | set(COMPILED_MODULES) <= names
    assert {name.partition("/")[0] for name in names if name.endswith(".py")} == {"gateway", "rtc3d"}


def test_with_a_compiler_the_wheel_is_compiled_for_this_platform(compiled: Built) -> None:
    skip_without_compiler()
    modules = {
        name.partition(".")[0] + ".py"
        for name in compiled.names_in_wheel
        if name.endswith(".so") and "/" in name
    }
    assert modules == set(COMPILED_MODULES)
    assert compiled.wheel.name.endswith(f"{sysconfig.get_platform().replace('-', '_')}.whl")


def test_a_compiled_module_names_no_folder_of_the_machine_that_built_it(compiled: Built) -> None:
    """Otherwise another machine would not build the same bytes."""
    skip_without_compiler()
    wheel = zipfile.ZipFile(compiled.wheel)
    modules = [wheel.read(name) for name in compiled.names_in_wheel if name.endswith(".so")]
    assert not any(path in module for module in modules for path in (b"/tmp/", b"/include/python"))


def test_a_compiled_wheel_runs_with_old_versions_of_glibc(compiled: Built, tmp_path: Path) -> None:
    """pip refuses a wheel for ``linux`` from an index, and takes one for ``manylinux``."""
    skip_without_compiler()
    code = (
        "import pathlib, sys; from release.wheels import set_manylinux_tag; "
        "set_manylinux_tag(*map(pathlib.Path, sys.argv[1:]))"
    )
    result = release("-c", code, compiled.wheel, tmp_path)
    assert result.returncode == 0, result.stderr
    [wheel] = tmp_path.iterdir()
    assert re.search(r"-manylinux2014_\w+\.manylinux_2_17_\w+\.whl$", wheel.name)
    names = {name for name in zipfile.ZipFile(wheel).namelist() if not name.endswith("/")}
    assert names == compiled.names_in_wheel


def test_without_a_compiler_the_wheel_is_for_any_platform_and_the_build_reports_what_is_missing(
    pure: Built,
) -> None:
    assert not any(name.endswith(".so") for name in pure.names_in_wheel)
    assert pure.wheel.name == f"rtc3d_gateway-{__version__}-py3-none-any.whl"
    [line] = [line for line in pure.output.splitlines() if "Not compiled" in line]
    assert "missing: no-such-compiler (Debian: apt-get install gcc python3-dev)" in line


def test_the_program_prints_its_version_and_that_it_is_compiled(program: Path, tmp_path: Path) -> None:
    skip_without_compiler()
    assert run(program, tmp_path, "--version") == f"rtc3d-gateway {__version__} (compiled)\n"


def test_pip_installs_the_sdist_without_a_compiler(python: Path, tmp_path: Path) -> None:
    program = python.with_name("rtc3d-gateway")
    assert run(program, tmp_path, "--version") == f"rtc3d-gateway {__version__} (pure Python)\n"


@pytest.mark.parametrize("name", ["gateway.yaml", "demo.yaml", "two-servers.yaml"])
def test_the_program_checks_a_configuration(program: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes((ROOT / "config" / name).read_bytes())
    assert "valid" in run(program, tmp_path, "check", name)


def test_the_program_runs_the_demo(program: Path, tmp_path: Path) -> None:
    assert "Nothing was lost." in run(program, tmp_path, "demo", "--seconds", "1")
