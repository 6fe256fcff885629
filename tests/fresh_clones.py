"""What tests of installing begin with: a clean copy of this repository, and packages without a network."""

import os
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[1]
WHEELHOUSE: Final = ROOT / "build/wheelhouse"
"""All that installing downloads, by ``make wheelhouse``."""

WHEELHOUSE_PYTHON: Final = ROOT / "build/wheelhouse-venv/bin/python"
"""SYSTEM_PYTHON with pip, which Debian's has not."""

SYSTEM_PYTHON: Final = os.environ.get("SYSTEM_PYTHON", "/usr/bin/python3")
"""The Python to install with: one that services can reach, which a developer's own is often not."""

_PROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())

COMPILED_MODULES: Final[list[str]] = _PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"][
    "include"
]
"""The files that are compiled where there is a C compiler, from ROOT."""


def skip_if_plain(said: str) -> None:
    """Skip a test of what is compiled where make ``said`` that it cannot be, but not in CI."""
    if "Plain Python" in said:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(said)


def clone_into(folder: Path) -> None:
    """Make ``folder`` what a fresh clone of this repository would be, with what has changed since."""
    git = ("git", "-c", "safe.directory=*", "-C", str(ROOT))
    listed = subprocess.check_output([*git, "ls-files", "-coz", "--exclude-standard"], text=True)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)


def files_in(folder: Path) -> set[str]:
    """Return the paths of all files in ``folder``, from there."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def pip_environment(wheelhouse: Path = WHEELHOUSE) -> dict[str, str]:
    """Return the environment in which pip, however it is called, installs without a network."""
    return {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheelhouse)}
