"""What the tests of a release share, each built once, because all that use it are in one worker."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.support.builds import Built, build
from tests.support.fresh_clones import (
    ROOT,
    SYSTEM_PYTHON,
    WHEELHOUSE_PYTHON,
    clone_into,
    pip_environment,
)
from tests.support.needs import need


@pytest.fixture(scope="session")
def compiled() -> Built:
    """What `make compiled` has built with `make wheel`: it is compiled if there is a compiler."""
    dist = ROOT / "build/compiled/wheel"
    need(dist.exists(), "needs the compiled modules: run make compiled first")
    return Built(dist, "")


@pytest.fixture(scope="session")
def pure(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The sdist, and the wheel of a machine without a compiler."""
    clone = tmp_path_factory.mktemp("clone")
    clone_into(clone)
    command = [str(WHEELHOUSE_PYTHON), "-B", "-m", "release.build", "sdist", "wheel"]
    return build(clone, command, CC="no-such-compiler")


@pytest.fixture(scope="session")
def python(pure: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with the packages of requirements.txt, and with the gateway, installed from the sdist."""
    folder = tmp_path_factory.mktemp("venv")
    subprocess.run([SYSTEM_PYTHON, "-m", "venv", "--without-pip", folder], check=True)
    environment = {**os.environ, **pip_environment()}
    python = folder / "bin/python"
    options = ("--quiet", "--no-deps", "--no-compile")
    pip = [str(WHEELHOUSE_PYTHON), "-m", "pip", f"--python={python}", "install", *options]
    subprocess.run([*pip, "--requirement", str(ROOT / "requirements.txt")], env=environment, check=True)
    subprocess.run([*pip, str(pure.sdist)], env=environment, check=True)
    return python
