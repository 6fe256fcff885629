"""The container image, built from the Debian package and run with podman as docs/how-to/container.md says.

The base is the bare system of the tests of the package instead of an image of a registry.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
import zenoh

from gateway import __version__
from tests.support.bare_debian import bare_root, quick_package
from tests.support.configurations import write_config
from tests.support.documents import ROOT
from tests.support.gateway_process import simulator
from tests.support.needs import need_programs
from tests.support.networks import free_endpoint, free_port, open_zenoh, zenoh_keys
from tests.support.waiting import wait_until

pytestmark = [pytest.mark.netns, pytest.mark.wheelhouse]

IMAGE: Final = f"localhost/rtc3d-gateway:{__version__}"
NAME: Final = "gateway"

# crun rejects a machine that has cgroups of both versions, so it sees only version 2. In memory, images are
# written and deleted faster.
NAMESPACE: Final = "mount -t cgroup2 none /sys/fs/cgroup && mount -t tmpfs none $1 && echo $$ && exec cat"

# An engine that runs in a container itself may have no cgroups, and may not raise limits: these are those of
# systemd/rtc3d-gateway.service.
CONFINED: Final = ("--cgroups=disabled", "--ulimit=nofile=8192:8192", "--ulimit=nproc=1024:1024")


class Podman:
    """An engine in the mount namespace of a process, with its storage on the tmpfs ``folder`` there."""

    def __init__(self, folder: str, namespace_pid: str) -> None:
        self._enter = ("nsenter", f"--target={namespace_pid}", "--mount", "--")
        storage = f'[storage]\ndriver="overlay"\ngraphroot="{folder}/storage"\nrunroot="{folder}/run"\n'
        configuration = Path(f"/proc/{namespace_pid}/root{folder}/storage.conf")
        configuration.write_text(storage)
        self._environment = {
            **os.environ,
            "CONTAINERS_STORAGE_CONF": f"{folder}/storage.conf",
            "TMPDIR": folder,
            "BUILDAH_ISOLATION": "chroot",  # needs no cgroups, either
        }

    def start(self, *command: str | Path) -> subprocess.Popen[str]:
        words = [*self._enter, *map(str, command)]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            words, env=self._environment, stdout=pipe, stderr=subprocess.STDOUT, text=True
        )

    def run(self, *command: str | Path) -> tuple[int, str]:
        """Return the exit status and the output of a command."""
        with self.start(*command) as process:
            output, _ = process.communicate()
        return process.returncode, output

    def check(self, *command: str | Path) -> str:
        """Return the output of a command, which must succeed."""
        status, output = self.run(*command)
        assert status == 0, output
        return output

    def inside(self, *command: str) -> tuple[int, str]:
        """Return the exit status and the output of a command in the container of the gateway."""
        return self.run("podman", "exec", NAME, *command)


@pytest.fixture(scope="module")
def podman() -> Iterator[Podman]:
    """Return an engine that has the image."""
    need_programs("podman", "crun", "unshare", packages="podman, crun and util-linux")
    package = quick_package()
    pipe = subprocess.PIPE
    with (
        tempfile.TemporaryDirectory(prefix="rtc3d-image-") as folder,
        subprocess.Popen(
            ["unshare", "--mount", "sh", "-c", NAMESPACE, "sh", folder], stdin=pipe, stdout=pipe, text=True
        ) as namespace,
    ):
        assert namespace.stdout is not None
        podman = Podman(folder, namespace.stdout.readline().strip())
        files = f"tar --create --directory={bare_root()} . | podman import --quiet - localhost/debian"
        podman.check("sh", "-c", files)
        podman.check(ROOT / "release/image/build", package, "--build-arg=BASE=localhost/debian")
        yield podman
        podman.run("podman", "kill", NAME)  # if the test has failed


def test_a_container_without_any_rights_delivers_data_and_ends_when_told_to(
    podman: Podman, tmp_path: Path
) -> None:
    """It has a read-only root without /tmp, no capabilities and no entry in /etc/passwd, as with docker."""
    endpoint = free_endpoint()
    metrics_port = free_port()
    frames: list[zenoh.Sample] = []
    # As with a file that an administrator wrote: other users can read it.
    tmp_path.chmod(0o755)
    with (
        open_zenoh("peer", listen=endpoint) as session,
        simulator() as (port, server),
    ):
        session.declare_subscriber("mocap/lab/3d", frames.append)
        write_config(
            tmp_path / "gateway.yaml",
            port,
            zenoh={"config": zenoh_keys("peer", connect=endpoint)},
            takes={"enabled": True},
        )
        with podman.start(
            *("podman", "run", f"--name={NAME}", *CONFINED, "--network=host"),
            *("--read-only", "--read-only-tmpfs=false", "--cap-drop=all", "--passwd=false"),
            *("--security-opt=no-new-privileges", f"--volume={tmp_path}:/etc/rtc3d-gateway:ro"),
            *(f"--env=RTC3D_GATEWAY__METRICS__{key}" for key in ("ENABLED=true", f"PORT={metrics_port}")),
            IMAGE,
        ) as gateway:
            wait_until(lambda: len(frames) > 10 or gateway.poll() is not None)
            assert gateway.poll() is None, gateway.communicate()[0]
            wait_until(lambda: podman.inside("healthz")[0] == 0)
            status, output = podman.inside(
                "sh", "-c", "id; grep Cap /proc/1/status; touch /etc/x /tmp/x takes/x"
            )
            assert status == 1
            assert output.startswith("uid=10001 gid=10001 groups=10001\n")
            assert {line.split()[1] for line in output.splitlines() if line.startswith("Cap")} == {"0" * 16}
            assert output.count("Read-only file system") == 2
            assert "takes/x" not in output, "the gateway has a folder for takes, and can write to it"

            server.kill()
            wait_until(lambda: podman.inside("healthz")[0] == 1)
            assert "connection refused" in podman.inside("healthz")[1]

            # A second signal, after 2 s, would be SIGKILL.
            podman.check("podman", "stop", "--time=2", NAME)
            assert gateway.wait() == 0
