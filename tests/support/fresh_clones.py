"""Helpers for tests of installing: a clean copy of this repository, and packages without a network."""

import os
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Final

from release.build import missing_to_compile
from tests.support.needs import need

ROOT: Final = Path(__file__).parents[2]
WHEELHOUSE: Final = ROOT / "build/wheelhouse"
"""All packages that installing downloads; ``make wheelhouse`` fills it."""

WHEELHOUSE_PYTHON: Final = ROOT / "build/wheelhouse-venv/bin/python"
"""SYSTEM_PYTHON with pip, which Debian's Python does not have."""

SYSTEM_PYTHON: Final = os.environ.get("SYSTEM_PYTHON", "/usr/bin/python3")
"""The Python to install with. Services must be able to run it, so it must not be in a home directory."""

QUICK_CC: Final = str(ROOT / "tests/quick-cc") if shutil.which("cc") else "cc"
"""A C compiler that does not optimise, if there is a compiler."""

_PROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())

COMPILED_MODULES: Final[list[str]] = _PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"][
    "include"
]
"""The paths from ROOT of the modules that are compiled if there is a C compiler."""


def skip_without_compiler() -> None:
    """Skip a test of compiled modules if nothing can compile them for this Python; fail in CI."""
    need(not (missing := missing_to_compile()), f"needs compiled modules; missing: {missing}")


def clone_into(folder: Path) -> None:
    """Copy this repository to ``folder`` as a fresh clone would, with uncommitted changes."""
    git = ("git", "-c", "safe.directory=*", "-C", str(ROOT))
    listed = subprocess.check_output([*git, "ls-files", "-coz", "--exclude-standard"], text=True)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)


def files_in(folder: Path) -> set[str]:
    """Return the paths of all files in ``folder``, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def pip_environment(wheelhouse: Path = WHEELHOUSE) -> dict[str, str]:
    """Return the environment variables with which pip and pipx install without a network."""
    # As a URL, because pip takes a variable apart at spaces.
    return {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": wheelhouse.as_uri()}
