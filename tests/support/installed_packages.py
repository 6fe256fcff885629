"""Packages with an entry point, as pip installs them: a module in a folder, and its metadata beside it."""

import sys
from pathlib import Path


def install_package(folder: Path, module: str, package: str, group: str, entry_point: str) -> None:
    """Install a package whose module has this text, and whose ``entry_point`` is NAME = MODULE:OBJECT."""
    info = folder / f"{package}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry_point}\n")
    (folder / f"{package}.py").write_text(module)
    sys.modules.pop(package, None)
