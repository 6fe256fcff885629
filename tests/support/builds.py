"""Builds of the sdist and of wheels in fresh clones, without a network."""

import subprocess
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tests.support.fresh_clones import ROOT, files_in, pip_environment
from tests.support.needs import need

SYSTEM_PATH: Final = "/usr/local/bin:/usr/bin:/bin"
_RELEASE_TOOLS: Final = ROOT / "build/release-venv"


class Built(NamedTuple):
    """The folder with what was built, and the output of the build."""

    dist: Path
    output: str

    @property
    def wheel(self) -> Path:
        [wheel] = self.dist.glob("*.whl")
        return wheel

    @property
    def sdist(self) -> Path:
        [sdist] = self.dist.glob("*.tar.gz")
        return sdist

    @property
    def names_in_wheel(self) -> set[str]:
        return set(zipfile.ZipFile(self.wheel).namelist())


def build(clone: Path, command: Sequence[str | Path], umask: int = 0o022, **environment: str) -> Built:
    """Run a command in a clone of this repository; it may leave nothing but files in dist/."""
    before = files_in(clone)
    environment = {"PATH": SYSTEM_PATH, **pip_environment(), **environment}
    output = subprocess.check_output(command, cwd=clone, env=environment, umask=umask, text=True)
    built = Built(clone / "dist", output)
    assert files_in(clone) == before | {f"dist/{path.name}" for path in built.dist.iterdir()}
    return built


def release(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the tools of a release; ``-m release.sbom`` is one of its programs."""
    need((_RELEASE_TOOLS / "complete").exists(), "needs the tools of a release: run make test-install")
    command = [_RELEASE_TOOLS / "bin/python", "-B", *arguments]
    environment = {"PATH": SYSTEM_PATH, **environment}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
