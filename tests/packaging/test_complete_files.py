"""A build that is killed leaves no incomplete file under its final name, which somebody could publish."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from release.build import complete_file
from release.deb.packages import DebianPackage, download
from tests.support.fresh_clones import ROOT

KILL = "kill -KILL $PPID; exit 1"
"""What a replaced program does after half of its work."""


def path_with(folder: Path, **programs: str) -> str:
    """Write shell scripts into a folder; return a PATH on which they come first."""
    folder.mkdir()
    for name, script in programs.items():
        program = folder / name.replace("_", "-")
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"


def visible(folder: Path) -> list[str]:
    """Return the files that `sha256sum *` and `twine upload dist/*` take."""
    return sorted(path.name for path in folder.glob("[!.]*"))


def test_a_file_has_its_name_once_it_is_complete(tmp_path: Path) -> None:
    """An error leaves the former file; the next build replaces what is left of this one."""
    path = tmp_path / "dist/SHA256SUMS"
    for is_complete in (False, True, False, True):
        before = visible(path.parent)
        try:
            with complete_file(path) as unfinished:
                unfinished.write_text("half")
                assert visible(path.parent) == before
                assert is_complete
        except AssertionError:
            assert visible(path.parent) == before
    assert path.read_text() == "half"
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_killed_build_leaves_no_debian_package(tmp_path: Path) -> None:
    """Its name would say that it is one, and `dpkg --install` would fail in the middle."""
    dist = tmp_path / "dist"
    (tmp_path / "stage").mkdir()
    half = f'for last; do :; done; echo half >"$last"; {KILL}'
    code = (
        "import sys; from pathlib import Path; from release.deb.build import pack; "
        "pack(Path(sys.argv[1]), Path(sys.argv[2]), 'none')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "stage", dist / "rtc3d-gateway_1.0_amd64.deb"],
        cwd=ROOT,
        env={**os.environ, "SOURCE_DATE_EPOCH": "0", "PATH": path_with(tmp_path / "bin", dpkg_deb=half)},
        check=False,
    )
    assert done.returncode < 0
    assert [path.read_text() for path in dist.iterdir()] == ["half\n"]
    assert visible(dist) == []


def test_a_killed_download_leaves_no_package_of_debian(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next build would refuse it, until somebody deletes it."""
    monkeypatch.setattr("release.deb.packages.ROOT", tmp_path)
    monkeypatch.setenv("PATH", path_with(tmp_path / "bin", apt_get="echo half >zlib1g_1_amd64.deb; exit 1"))
    with pytest.raises(SystemExit):
        download(DebianPackage("zlib1g", "1", "0" * 64))
    assert visible(tmp_path / "build/deb") == []


def test_a_killed_build_leaves_no_image(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    shutil.copytree(ROOT / "release/image", tree / "release/image")
    for file in ("Makefile", "release/release.mk", "gateway/__init__.py"):
        (tree / file).parent.mkdir(exist_ok=True)
        shutil.copyfile(ROOT / file, tree / file)
    [dist, build] = [tree / name for name in ("dist", "build")]
    dist.mkdir()
    build.mkdir()
    half = f'echo half >"$3"; {KILL}'
    path = path_with(tmp_path / "bin", podman=":", dpkg_deb="echo 1.0", cp=":", git="echo 0", tar=half)
    done = subprocess.run(
        ["make", "--old-file=deb", "image"],
        cwd=tree,
        env={**os.environ, "PATH": path, "MAKEFLAGS": ""},
        capture_output=True,
        check=False,
    )
    assert done.returncode
    assert [path.read_text() for path in build.iterdir()] == ["half\n"]
    assert visible(dist) == []
