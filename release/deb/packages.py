"""The packages of Debian whose files are in the package of the gateway.

python -m release.deb.packages --newest    print the list with the versions that apt has now
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

from release.build import ROOT

LIST: Final = Path(os.environ.get("DEB_PACKAGES", Path(__file__).with_name("packages.txt")))
"""Tests may use newer versions than a release: their list is elsewhere."""


class DebianPackage(NamedTuple):
    """A line of packages.txt."""

    name: str
    version: str
    sha256: str


def debian_packages() -> Iterator[DebianPackage]:
    """Yield the packages of Debian that packages.txt names."""
    for line in LIST.read_text().splitlines():
        if not line.startswith("#"):
            yield DebianPackage(*line.split())


def contained_packages() -> list[DebianPackage]:
    """Return those whose files are in the package of the gateway."""
    return [package for package in debian_packages() if package.name != "patchelf"]


def debian_purl(name: str, version: str, architecture: str) -> str:
    """Return the package URL of a package of Debian 12."""
    return f"pkg:deb/debian/{name}@{quote(version)}?arch={architecture}&distro=bookworm"


def download(package: DebianPackage) -> Path:
    """Return the file of a package of Debian; apt downloads it if it is not there yet."""
    folder = ROOT / "build/deb"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{package.name}_{package.version}_amd64.deb"
    if not path.exists():
        option = "APT::Sandbox::User=root"
        version = f"{package.name}={package.version}"
        with tempfile.TemporaryDirectory(dir=folder) as unfinished:
            command = ["apt-get", "--option", option, "download", "--quiet=2", version]
            if subprocess.run(command, cwd=unfinished, check=False).returncode:
                sys.exit(f"apt-get has no {version}: run `apt-get update`, or `make deb-lock`.")
            (Path(unfinished) / path.name).rename(path)
    if (found := hashlib.sha256(path.read_bytes()).hexdigest()) != package.sha256:
        sys.exit(
            f"{path} has the SHA-256 {found}, not the one in release/deb/packages.txt. Delete it and retry."
        )
    return path


def newest_list() -> str:
    """Return the list with the versions that apt has now."""
    lines = [line for line in LIST.read_text().splitlines() if line.startswith("#")]
    for package in debian_packages():
        command = ("apt-cache", "show", "--no-all-versions", package.name)
        shown = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        fields = dict(line.split(": ", 1) for line in shown.splitlines() if ": " in line and line[0] != " ")
        lines.append(f"{package.name} {fields['Version']} {fields['SHA256']}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if sys.argv[1:] != ["--newest"]:
        sys.exit(__doc__)
    print(newest_list(), end="")
