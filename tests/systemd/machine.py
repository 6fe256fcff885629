"""A machine for installation tests: a systemd in its own namespaces, with the network of the test run.

What is typed on it is in docs/how-to/service.md.
"""

import asyncio
import json
import re
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from tests.support.fresh_clones import ROOT, SYSTEM_PYTHON, WHEELHOUSE, pip_environment
from tests.support.networks import zenoh_keys

UNIT: Final = "rtc3d-gateway.service"
CONFIG: Final = "/etc/rtc3d-gateway/gateway.yaml"
DROP_INS: Final = f"/etc/systemd/system/{UNIT}.d"
CLONE: Final = "/tmp/clone"
_REPOSITORY: Final = Path("/run/repository")
_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_PAGE: Final = (ROOT / "docs/how-to/service.md").read_text()
_AS_ROOT: Final = 'sudo() { "$@"; }; set -e\n'


def commands(heading: str, number: int = 0) -> str:
    """Return the commands of a block below a heading, for a shell that runs as root."""
    [section] = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", _PAGE, re.MULTILINE | re.DOTALL)
    blocks: list[str] = re.findall(r"^```sh\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    return _AS_ROOT + blocks[number]


def exposure() -> tuple[str, str]:
    """Return the exposure level that the page claims, and the version of systemd that it is for."""
    [(figure, version)] = re.findall(r"gives an exposure of (\d\.\d) with systemd (\d+) ", _PAGE)
    return figure, version


class Outcome(NamedTuple):
    """The exit status of a command and its output, standard error included."""

    status: int
    text: str


class Machine:
    """A machine that ``with-systemd`` has booted; ``init_pid`` is its process 1, as numbered outside."""

    def __init__(self, init_pid: int) -> None:
        self._init_pid = init_pid
        self._files = Path(f"/proc/{init_pid}/root")
        self.left_in_clone: set[str] = set()
        """The files that installing created in the clone."""
        self.install_output = ""

    def path(self, path: str) -> Path:
        """Return the path outside the machine of a file in it."""
        return self._files / path.removeprefix("/")

    def write(self, path: str, text: str) -> None:
        """Write a file that all users of the machine can read."""
        self.path(path).write_text(text)
        self.path(path).chmod(0o644)

    async def run(
        self, *command: str, check: bool = True, environment: Mapping[str, str] | None = None
    ) -> Outcome:
        """Run a command in the machine as root."""
        namespaces = ("--pid", "--mount", "--uts", "--ipc", "--cgroup")
        process = await asyncio.create_subprocess_exec(
            *("nsenter", f"--target={self._init_pid}", *namespaces, "--", *command),
            env={"PATH": _PATH, **(environment or {})},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        outcome = Outcome(process.returncode or 0, output.decode())
        assert not check or outcome.status == 0, f"{' '.join(command)}: {outcome.text}"
        return outcome

    async def run_shell(self, commands: str, check: bool = True) -> Outcome:
        """Run ``commands`` with a shell in CLONE; pip installs from the wheelhouse only."""
        environment = pip_environment(_REPOSITORY / WHEELHOUSE.relative_to(ROOT)) | {"PYTHON": SYSTEM_PYTHON}
        script = f"mkdir -p {CLONE} && cd {CLONE}\n{commands}"
        return await self.run("sh", "-c", script, check=check, environment=environment)

    async def files(self) -> dict[str, str]:
        """Return size and modification time of all files in the writable folders, by path.

        Folders have neither. The files that systemd writes for itself are left out.
        """
        writable = ("/dev/shm", "/etc", "/home", "/opt", "/root", "/run", "/tmp", "/usr/local", "/var")
        of_systemd = (
            "/run/systemd",
            "/run/log",
            "/run/overlay",
            "/run/repository",
            "/var/lib/systemd",
            CLONE,
        )
        skipped = [part for path in of_systemd for part in ("-path", path, "-prune", "-o")]
        # Not of folders: their time changes with their files, which are listed.
        each = ("-type", "d", "-printf", r"%p\t\n", "-o", "-printf", r"%p\t%s %T@\n")
        listed = await self.run("find", *writable, *skipped, *each)
        return dict(line.rsplit("\t", 1) for line in listed.text.splitlines())

    async def show(self, name: str, unit: str = UNIT) -> str:
        """Return a property of a unit."""
        return (await self.run("systemctl", "show", "--value", "--property", name, unit)).text.strip()

    async def wait_for(self, name: str, wanted: str, unit: str = UNIT, timeout_s: float = 120) -> str:
        """Wait until a property of a unit contains ``wanted``, and return the property."""
        value = ""
        try:
            async with asyncio.timeout(timeout_s):
                while wanted not in (value := await self.show(name, unit)):  # noqa: ASYNC110 - systemd has no event for it
                    await asyncio.sleep(0.02)
        except TimeoutError:
            raise AssertionError(f"{name} of {unit} is {value!r}, without {wanted!r}") from None
        return value

    async def journal(self, unit: str = UNIT) -> list[dict[str, Any]]:
        """Return the journal entries of the unit's current or last run, with all that was logged before."""
        await self.run("journalctl", "--sync")
        invocation = await self.show("InvocationID", unit)
        matches = (f"_SYSTEMD_INVOCATION_ID={invocation}", "+", f"INVOCATION_ID={invocation}")
        text = (await self.run("journalctl", "--output=json", "--all", *matches)).text
        return [json.loads(line) for line in text.splitlines()]


@contextmanager
def booted(root: Path | None = None) -> Iterator[Machine]:
    """Boot a machine with the system in the folder ``root``, or else with that of this machine."""
    options = () if root is None else ("--root", str(root))
    # The machine runs until cat ends, which happens when this process closes the pipe or dies.
    command = ["tests/systemd/with-systemd", *options, "sh", "-c", "echo $MACHINE; exec cat"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield Machine(int(process.stdout.readline()))


class Service:
    """The service for one configuration in the machine."""

    def __init__(self, machine: Machine, endpoint: str) -> None:
        self.machine = machine
        self.endpoint = endpoint
        """The endpoint on which Zenoh listens."""

    def configure(self, sources: Mapping[str, int], **sections: Any) -> None:
        """Write a configuration with these ports of sources by name; ``sections`` are added or replaced."""
        reconnect = {"first_delay_s": 0.05, "max_delay_s": 0.1}
        configuration = {
            "sources": [
                {"name": name, "host": "127.0.0.1", "port": port, "reconnect": reconnect}
                for name, port in sources.items()
            ],
            "zenoh": {"config": zenoh_keys("peer", listen=self.endpoint)},
            "lcm": {"enabled": False},
            "metrics": {"enabled": False},
        }
        self.machine.write(CONFIG, yaml.safe_dump(configuration | sections))

    async def drop_in(self, *lines: str) -> None:
        """Add lines to the section [Service] of the unit, as ``systemctl edit`` does."""
        folder = self.machine.path(DROP_INS)
        folder.mkdir(parents=True)
        (folder / "test.conf").write_text("\n".join(("[Service]", *lines)))
        await self.machine.run("systemctl", "daemon-reload")

    async def start(self) -> None:
        await self.machine.run("systemctl", "start", UNIT)

    async def reload(self) -> Outcome:
        """Run ``systemctl reload``."""
        return await self.machine.run("systemctl", "reload", UNIT, check=False)

    async def wait_for_status(self, text: str) -> None:
        """Wait until the status line of ``systemctl status`` contains ``text``."""
        await self.machine.wait_for("StatusText", text)

    async def main_pid(self) -> str:
        return await self.machine.show("MainPID")
