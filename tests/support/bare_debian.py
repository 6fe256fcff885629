"""A bare Debian 12, and the Debian package of this repository, for tests of the package and of the image.

``make test-install`` runs this program, because the tests have no network: it makes the bare systems, and
downloads the packages of Debian that are in the package.
"""

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from gateway import __version__
from release.deb.packages import LIST, debian_packages, download, newest_list
from tests.support.fresh_clones import QUICK_CC, ROOT, WHEELHOUSE, WHEELHOUSE_PYTHON, pip_environment
from tests.support.needs import need

_FOLDER: Final = ROOT / "build/bare-debian-12"
_ROOT_FILES: Final = _FOLDER / "root"
_COMPLETE: Final = _FOLDER / "complete"
_PACKAGES: Final = _FOLDER / "packages.txt"

PYTHON_ROOT: Final = _FOLDER / "python-root"
"""The root folder of a Debian 12 that also has Python, for the wheels."""


def bare_root() -> Path:
    """Return the root folder of a bare Debian 12 with systemd: no compiler, no Python. It must not change."""
    need(
        _COMPLETE.exists(),
        "needs a bare Debian 12: run `make test-install` as root, with debootstrap installed",
    )
    return _ROOT_FILES


@functools.cache
def quick_package() -> Path:
    """Return the Debian package of the sources as they are: pure Python, and not compressed."""
    return build_package(Path(tempfile.mkdtemp(prefix="rtc3d-gateway-package-")), "pure")


def build_package(folder: Path, kind: str, version: str = __version__, repository: Path = ROOT) -> Path:
    """Build the package in a folder without compressing it; ``kind`` is that of its wheel."""
    python = (str(WHEELHOUSE_PYTHON), "-B", "-m")
    environment = {**os.environ, **pip_environment(), "CC": QUICK_CC, "DEB_PACKAGES": str(_PACKAGES)}
    wheel = ("release.build", "--dist", str(folder), kind)
    subprocess.run([*python, *wheel], cwd=repository, env=environment, check=True)
    [built] = folder.glob("*.whl")
    options = ("--compression=none", f"--version={version}", f"--output={folder}")
    package = ("release.deb.build", str(built), str(WHEELHOUSE), *options)
    subprocess.run([*python, *package], cwd=repository, env=environment, check=True)
    [path] = folder.glob("*.deb")
    return path


def main() -> None:
    """Run the program."""
    os.umask(0o022)  # debootstrap makes folders that all users of the system must be able to enter
    subprocess.run(["apt-get", "update", "--quiet=2"], check=True)
    _COMPLETE.unlink(missing_ok=True)
    _FOLDER.mkdir(parents=True, exist_ok=True)
    newest = newest_list()
    if newest != LIST.read_text():
        print(
            f"Debian has newer packages than {LIST.name} names: run `make deb-lock` before the next release."
        )
    _PACKAGES.write_text(newest)
    command = (sys.executable, "-B", "-c", "from tests.support.bare_debian import fetch; fetch()")
    subprocess.run(command, cwd=ROOT, env={**os.environ, "DEB_PACKAGES": str(_PACKAGES)}, check=True)
    _make_root(_ROOT_FILES, "systemd-sysv")
    _make_root(PYTHON_ROOT, "systemd-sysv,python3-venv,libglib2.0-0")
    _COMPLETE.touch()


def _make_root(root: Path, packages: str) -> None:
    """Make the root folder of a Debian 12 with these packages, unless it exists."""
    if root.exists():
        return
    shutil.rmtree(unfinished := _FOLDER / "unfinished", ignore_errors=True)
    debootstrap = ("debootstrap", "--variant=minbase", f"--include={packages}", "bookworm")
    command = ("unshare", "--mount", *debootstrap, unfinished, _mirror())
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    (unfinished / "etc/apt/apt.conf.d/yes").write_text('APT::Get::Assume-Yes "true";\n')
    unfinished.rename(root)


def fetch() -> None:
    """Download the packages of Debian that are in the package."""
    for package in debian_packages():
        download(package)


def _mirror() -> str:
    """Return the mirror of Debian 12 that this machine uses."""
    target = ("Codename: bookworm", "Created-By: Packages")
    command = ("apt-get", "indextargets", "--format=$(REPO_URI)", *target)
    return subprocess.check_output(command, text=True).split()[0]


if __name__ == "__main__":
    main()
