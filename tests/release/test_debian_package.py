"""The Debian package of `make deb`, on a bare Debian 12: systemd, no compiler, no Python, no network.

The upgrade begins with the package of the previous commit.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from gateway import __version__
from tests.support.bare_debian import bare_root, build_package
from tests.support.errors import names
from tests.support.fresh_clones import ROOT, pip_environment
from tests.systemd.machine import CLONE, CONFIG, UNIT, Machine, booted, commands

pytestmark = [
    pytest.mark.systemd,
    pytest.mark.wheelhouse,
    pytest.mark.netns,
    pytest.mark.timeout(1800),
]

INSTANCE: Final = "rtc3d-gateway@hall-2.service"
TAKE: Final = "/var/lib/rtc3d-gateway/takes/walk.lcmlog"
MINE: Final = "sources: [{name: mine, host: 192.0.2.20}]\n"
NEWER: Final = f"{__version__}+newer"

# What apt and systemd write for themselves, whatever package is installed.
OF_OTHERS: Final = ("/var/cache/apt", "/var/lib/apt", "/var/lib/systemd", "/var/log")


@pytest.fixture(scope="module")
def package() -> Path:
    """Return the package of this repository."""
    environment = {**os.environ, **pip_environment(), "MAKEFLAGS": ""}  # tests have no network
    subprocess.run(["make", "--silent", "deb"], cwd=ROOT, check=True, env=environment)
    return ROOT / f"dist/rtc3d-gateway_{__version__}_amd64.deb"


async def install(machine: Machine, package: Path) -> None:
    """Install a package as the page says."""
    folder = machine.path(CLONE)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    shutil.copy(package, folder)
    await machine.run_shell(
        "export DEBIAN_FRONTEND=noninteractive\n" + commands("Install the Debian package")
    )


async def all_files(machine: Machine) -> set[str]:
    """Return the paths of all files, links and folders of the machine."""
    skipped = [part for path in OF_OTHERS for part in ("-path", path, "-prune", "-o")]
    return set((await machine.run("find", "/", "-xdev", *skipped, "-print")).text.splitlines())


@pytest.fixture
def bare_machine() -> Iterator[Machine]:
    with booted(bare_root()) as machine:
        yield machine


async def test_a_bare_machine_runs_the_service_at_once(bare_machine: Machine, package: Path) -> None:
    """apt starts a service that waits for its server, and the README's commands work with nothing else."""
    assert (await bare_machine.run("sh", "-c", "command -v python3 gcc cc make git", check=False)).text == ""
    await install(bare_machine, package)
    assert await bare_machine.show("ActiveState") == "active"
    assert await bare_machine.show("UnitFileState") == "enabled"
    await bare_machine.wait_for("StatusText", "lab: waiting for 192.0.2.20:3020")

    run = bare_machine.run
    # The package has each library that its own ones need, or depends on a package that has it.
    load = (
        "import ctypes, pathlib, ssl\n"
        "import lcm, zenoh, numpy, lxml.etree, ezc3d, foxglove, pylsl, cysystemd.journal, uvloop, viser\n"
        "for path in pathlib.Path('/opt/rtc3d-gateway').rglob('*.so'):\n"
        "    if '.libs' not in str(path.parent): ctypes.CDLL(str(path))\n"
    )
    await run("/opt/rtc3d-gateway/venv/bin/python", "-I", "-c", load)
    assert (await run("rtc3d-gateway", "--version")).text.startswith(f"rtc3d-gateway {__version__}")
    assert names((await run("rtc3d-gateway", "config", "check")).text, 1, "lab")
    assert "Nothing was lost." in (await run("rtc3d-gateway", "demo", "--seconds", "1")).text
    doctor = await run("rtc3d-gateway", "doctor", check=False)
    assert doctor.status == 1
    assert names(doctor.text, "192.0.2.20:3020", "Network is unreachable")
    assert (await run("dpkg", "--verify", "rtc3d-gateway")).text == ""
    page = bare_machine.path("/usr/share/man/man1/rtc3d-gateway.1.gz")
    assert page.stat().st_mode & 0o777 == 0o644
    schema = bare_machine.path("/usr/share/rtc3d-gateway/gateway.schema.json")
    assert schema.read_text() == (ROOT / "config/gateway.schema.json").read_text()
    completion = (
        "COMP_WORDS=(rtc3d-gateway do) COMP_CWORD=1; _rtc3d_gateway_completion rtc3d-gateway; echo $COMPREPLY"
    )
    source = ". /usr/share/bash-completion/completions/rtc3d-gateway"
    assert (await run("bash", "-c", f"{source}; {completion}")).text == "doctor\n"


async def test_an_upgrade_keeps_configuration_and_takes(
    bare_machine: Machine, package: Path, tmp_path: Path
) -> None:
    """Services that run are restarted, also further instances; one that is stopped stays stopped."""
    older = previous_package(tmp_path) or package
    newer = with_version(package, NEWER, tmp_path)
    await install(bare_machine, older)
    bare_machine.write(CONFIG, MINE)
    bare_machine.write("/etc/rtc3d-gateway/hall-2.yaml", f"{MINE}metrics: {{enabled: false}}\n")
    bare_machine.path(TAKE).parent.mkdir()
    bare_machine.path(TAKE).write_bytes(b"take")
    await bare_machine.run("systemctl", "restart", UNIT)
    await bare_machine.run("systemctl", "start", INSTANCE)
    runs = [await bare_machine.show("InvocationID", unit) for unit in (UNIT, INSTANCE)]

    await install(bare_machine, newer)
    for unit, run in zip((UNIT, INSTANCE), runs, strict=True):
        assert await bare_machine.show("ActiveState", unit) == "active"
        assert await bare_machine.show("InvocationID", unit) != run
    await bare_machine.wait_for("StatusText", "mine: waiting for")
    assert bare_machine.path(CONFIG).read_text() == MINE
    assert bare_machine.path(TAKE).read_bytes() == b"take"
    version = await bare_machine.run("dpkg-query", "--show", "--showformat=${Version}", "rtc3d-gateway")
    assert version.text == NEWER

    await bare_machine.run("systemctl", "stop", UNIT)
    await bare_machine.run("systemctl", "disable", UNIT)
    await bare_machine.run_shell("dpkg --install ./rtc3d-gateway_*_amd64.deb")
    assert await bare_machine.show("ActiveState") == "inactive"
    assert await bare_machine.show("UnitFileState") == "disabled"


async def test_removing_keeps_what_is_yours_and_purging_leaves_nothing(
    bare_machine: Machine, package: Path
) -> None:
    before = await all_files(bare_machine)
    users = bare_machine.path("/etc/passwd").read_text(), bare_machine.path("/etc/group").read_text()
    await install(bare_machine, package)
    bare_machine.write(CONFIG, MINE)
    bare_machine.path("/etc/rtc3d-gateway/secrets/key.pem").write_text("key")
    bare_machine.write("/etc/rtc3d-gateway/hall-2.yaml", f"{MINE}metrics: {{enabled: false}}\n")
    bare_machine.path(TAKE).parent.mkdir()
    bare_machine.path(TAKE).write_bytes(b"take")
    await bare_machine.run("systemctl", "enable", "--now", INSTANCE)

    await bare_machine.run_shell(commands("Remove"))
    for unit in (UNIT, INSTANCE):
        assert await bare_machine.show("ActiveState", unit) == "inactive"
    assert not bare_machine.path("/opt/rtc3d-gateway").exists()
    assert bare_machine.path(CONFIG).read_text() == MINE
    assert bare_machine.path(TAKE).read_bytes() == b"take"

    await bare_machine.run_shell(commands("Remove", 1))
    assert await all_files(bare_machine) - before == set()
    now = bare_machine.path("/etc/passwd").read_text(), bare_machine.path("/etc/group").read_text()
    assert now == users


async def test_the_package_refuses_to_replace_an_installation_from_source(
    bare_machine: Machine, package: Path
) -> None:
    unit = bare_machine.path(f"/usr/local/lib/systemd/system/{UNIT}")
    unit.parent.mkdir(parents=True)
    unit.touch()
    with pytest.raises(AssertionError, match="sudo make uninstall"):
        await install(bare_machine, package)
    assert not bare_machine.path("/opt/rtc3d-gateway/venv").exists()


def with_version(package: Path, version: str, folder: Path) -> Path:
    """Return a copy of a package, uncompressed, that has another version."""
    files = folder / version
    subprocess.run(["dpkg-deb", "--raw-extract", package, files], check=True)
    control = files / "DEBIAN/control"
    control.write_text(control.read_text().replace(f"Version: {__version__}\n", f"Version: {version}\n"))
    path = folder / f"rtc3d-gateway_{version}_amd64.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", "-Znone", "--build", files, path], check=True)
    shutil.rmtree(files)
    return path


def previous_package(folder: Path) -> Path | None:
    """Return the package of the previous commit; None if that commit cannot build one."""
    previous, output = folder / "previous", folder / "built"
    git = ("git", "-c", "safe.directory=*", "-C", str(ROOT))
    subprocess.run([*git, "worktree", "add", "--detach", previous, "HEAD~1"], check=True)
    try:
        if not (previous / "release/deb/build.py").exists():
            return None
        (previous / "build").mkdir()
        (previous / "build/deb").symlink_to(ROOT / "build/deb")  # what apt has downloaded
        return build_package(output, "compiled", f"{__version__}~previous", previous)
    finally:
        subprocess.run([*git, "worktree", "remove", "--force", previous], check=True)
