"""The script of the Debian package for ``apt purge``, in folders of its own: mounts in a mount namespace."""

import os
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.support.fresh_clones import ROOT
from tests.support.needs import need, need_programs

STATE: Final = "/var/lib/rtc3d-gateway"
SYSTEM_USER: Final = "rtc3d-gateway:x:990:990:RTC3D gateway:/:/usr/sbin/nologin"

_SETUP: Final = f"""
set -e
mount -t tmpfs none /var/lib
mount -t tmpfs none /etc
mkdir -p {STATE}/takes/lab /etc/rtc3d-gateway/secrets
echo 1 >{STATE}/takes/lab/old.lcmlog
echo 1 >/etc/rtc3d-gateway/gateway.yaml
"""


class Purge:
    """Runs the script; the programs that change users only write what they are called with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.user = SYSTEM_USER
        self.is_user_busy = False

    def _program(self, name: str, text: str) -> None:
        path = self.folder / name
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    def run(self, setup: str) -> tuple[str, list[str]]:
        """Purge; return what is printed, and the files and folders that are left."""
        log = self.folder / "calls"
        self._program("getent", f"[ ! -e '{self.folder}/deleted' ] && echo '{self.user}'")
        self._program("userdel", "exit 8" if self.is_user_busy else f"touch '{self.folder}/deleted'")
        self._program("groupdel", f"echo groupdel >>'{log}'")
        self._program("systemctl", "true")
        self._program("deb-systemd-helper", "true")
        found = self.folder / "found"
        script = (
            f"{_SETUP}{setup}\nsh '{ROOT}/release/deb/postrm' purge 2>&1\n"
            f"find {STATE} /etc/rtc3d-gateway /var/lib/big 2>/dev/null >'{found}' || true\n"
        )
        done = subprocess.run(
            ["unshare", "--mount", "sh", "-c", script],
            env={**os.environ, "PATH": f"{self.folder}:{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout, sorted(found.read_text().splitlines())

    @property
    def is_user_deleted(self) -> bool:
        """Whether the user was deleted."""
        return (self.folder / "deleted").exists()


@pytest.fixture
def purge(tmp_path: Path) -> Purge:
    need_programs("unshare", "mountpoint", packages="util-linux")
    can_mount = subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False)
    need(can_mount.returncode == 0, "needs mount namespaces: run tests with tests/with-netns")
    return Purge(tmp_path)


def test_everything_is_deleted(purge: Purge) -> None:
    """Nothing stays, whatever the names are."""
    _, left = purge.run(
        f"mkdir '{STATE}/takes/a b\n-c'; echo >'{STATE}/takes/a b\n-c/-x'; ln -s / {STATE}/link"
    )
    assert (left, purge.is_user_deleted) == ([], True)


@pytest.mark.parametrize(
    "mount",
    ["mount -t tmpfs none {}", "mkdir /var/lib/other && mount --bind /var/lib/other {}"],
    ids=["disk", "bind"],
)
@pytest.mark.parametrize("name", ["takes", "takes/lab/my disk"])
def test_takes_on_a_disk_that_is_mounted_below_are_kept(purge: Purge, mount: str, name: str) -> None:
    """Somebody has a disk for them, and purging the program must not cost years of recordings."""
    folder = f"{STATE}/{name}"
    text, left = purge.run(
        f"mkdir -p '{folder}'; {mount.format(repr(folder))}; mkdir '{folder}/lab'\n"
        f"touch '{folder}/lab/a.lcmlog'; mkdir {STATE}/zzz; touch {STATE}/zzz/b"
    )
    parents = {folder, *map(str, Path(folder).parents)} - {"/", "/var", "/var/lib"}
    assert left == sorted([*parents, f"{folder}/lab", f"{folder}/lab/a.lcmlog"])
    assert folder in text


@pytest.mark.parametrize("folder", [STATE, "/etc/rtc3d-gateway"])
def test_a_folder_that_is_a_mount_point_stays_empty(purge: Purge, folder: str) -> None:
    """Only the person who has mounted the disk can remove it."""
    text, left = purge.run(f"mount -t tmpfs none {folder}; mkdir {folder}/x; touch {folder}/x/y")
    assert left == [folder]
    assert folder in text


def test_a_link_is_removed_without_what_it_points_to(purge: Purge) -> None:
    """The state folder may be a link to another disk."""
    _, left = purge.run(f"mv {STATE} /var/lib/big; ln -s /var/lib/big {STATE}; touch /var/lib/big/take")
    assert [path for path in left if "big" not in path] == []
    assert "/var/lib/big/take" in left


@pytest.mark.parametrize(
    "user",
    ["rtc3d-gateway:x:1001:1001::/home/r:/bin/bash", "rtc3d-gateway:x:990:990::/home/r:/bin/bash"],
)
def test_a_person_with_the_name_of_the_service_is_kept(purge: Purge, user: str) -> None:
    """systemd-sysusers uses an existing user, who is not the package's to delete."""
    purge.user = user
    purge.run("")
    assert not purge.is_user_deleted


def test_a_user_with_running_processes_does_not_end_the_purge(purge: Purge) -> None:
    """Otherwise, the package would be left half purged."""
    purge.is_user_busy = True
    _, left = purge.run("")
    assert (left, purge.is_user_deleted) == ([], False)
