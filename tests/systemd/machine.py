"""A machine to install the gateway on: a systemd in namespaces of its own, with this run's network."""

import asyncio
import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from tests.clones import ROOT, SYSTEM_PYTHON, WHEELHOUSE, pip_environment
from tests.networks import zenoh_keys

UNIT: Final = "rtc3d-gateway.service"
CONFIG: Final = "/etc/rtc3d-gateway/gateway.yaml"
DROP_INS: Final = f"/etc/systemd/system/{UNIT}.d"
CLONE: Final = "/tmp/clone"
_REPOSITORY: Final = Path("/run/repository")
_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class Outcome(NamedTuple):
    """How a command ended, and all that it printed."""

    status: int
    text: str


class Machine:
    """A running one, as ``with-systemd`` boots it; ``process_1`` is its process 1, seen from here."""

    def __init__(self, process_1: int) -> None:
        self._process_1 = process_1
        self._files = Path(f"/proc/{process_1}/root")
        self.left_in_clone: set[str] = set()
        """What installing made in the clone."""
        self.said_installing = ""

    def path(self, path: str) -> Path:
        """Return where a file of the machine is, seen from here."""
        return self._files / path.removeprefix("/")

    async def run(
        self, *command: str, check: bool = True, environment: Mapping[str, str] | None = None
    ) -> Outcome:
        """Run a command in the machine, as root, and return how it ended."""
        namespaces = ("--pid", "--mount", "--uts", "--ipc", "--cgroup")
        process = await asyncio.create_subprocess_exec(
            *("nsenter", f"--target={self._process_1}", *namespaces, "--", *command),
            env={"PATH": _PATH, **(environment or {})},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        outcome = Outcome(process.returncode or 0, output.decode())
        assert not check or outcome.status == 0, f"{' '.join(command)}: {outcome.text}"
        return outcome

    async def type(self, commands: str, check: bool = True) -> Outcome:
        """Have a shell run ``commands`` in the clone at CLONE; pip takes what is downloaded already."""
        environment = pip_environment(_REPOSITORY / WHEELHOUSE.relative_to(ROOT)) | {"PYTHON": SYSTEM_PYTHON}
        script = f"cd {CLONE}\n{commands}"
        return await self.run("sh", "-c", script, check=check, environment=environment)

    async def files(self) -> dict[str, str]:
        """Return all files and folders that somebody could change, with size and time of change.

        What systemd writes for itself is left out; the rest of the machine cannot be written to.
        """
        places = ("/dev/shm", "/etc", "/home", "/opt", "/root", "/run", "/tmp", "/usr/local", "/var")
        own = ("/run/systemd", "/run/log", "/run/overlay", "/run/repository", "/var/lib/systemd", CLONE)
        skipped = [part for path in own for part in ("-path", path, "-prune", "-o")]
        # Of a folder the name alone: its time changes with what is in it, which is listed itself.
        each = ("-type", "d", "-printf", r"%p\t\n", "-o", "-printf", r"%p\t%s %T@\n")
        listed = await self.run("find", *places, *skipped, *each)
        return dict(line.rsplit("\t", 1) for line in listed.text.splitlines())

    async def show(self, name: str, unit: str = UNIT) -> str:
        """Return a property of a unit."""
        return (await self.run("systemctl", "show", "--value", "--property", name, unit)).text.strip()

    async def until(self, name: str, wanted: str, unit: str = UNIT, timeout_s: float = 15) -> str:
        """Wait until a property of a unit has ``wanted`` in it, and return the property."""
        value = ""
        try:
            async with asyncio.timeout(timeout_s):
                while wanted not in (value := await self.show(name, unit)):  # noqa: ASYNC110 - systemd is asked
                    await asyncio.sleep(0.02)
        except TimeoutError:
            raise AssertionError(f"{name} of {unit} is {value!r}, without {wanted!r}") from None
        return value

    async def journal(self, unit: str = UNIT) -> list[dict[str, Any]]:
        """Return the journal's entries about the unit's present or last run."""
        run = await self.show("InvocationID", unit)
        matches = (f"_SYSTEMD_INVOCATION_ID={run}", "+", f"INVOCATION_ID={run}")
        text = (await self.run("journalctl", "--output=json", "--all", *matches)).text
        return [json.loads(line) for line in text.splitlines()]


class Service:
    """The service of one configuration, running in the machine."""

    def __init__(self, machine: Machine, endpoint: str) -> None:
        self.machine = machine
        self.endpoint = endpoint
        """Where Zenoh listens."""

    def configure(self, sources: Mapping[str, int], **sections: Any) -> None:
        """Write a configuration: sources by name with their ports; other sections beside or over these."""
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
        self.machine.path(CONFIG).write_text(yaml.safe_dump(configuration | sections))

    async def drop_in(self, *lines: str) -> None:
        """Change the unit as ``systemctl edit`` does, with lines of its section [Service]."""
        folder = self.machine.path(DROP_INS)
        folder.mkdir(parents=True)
        (folder / "test.conf").write_text("\n".join(("[Service]", *lines)))
        await self.machine.run("systemctl", "daemon-reload")

    async def start(self) -> None:
        await self.machine.run("systemctl", "start", UNIT)

    async def reload(self) -> Outcome:
        """Return how ``systemctl reload`` ended."""
        return await self.machine.run("systemctl", "reload", UNIT, check=False)

    async def says(self, text: str) -> None:
        """Wait until the line in ``systemctl status`` has ``text`` in it."""
        await self.machine.until("StatusText", text)

    async def main_pid(self) -> str:
        return await self.machine.show("MainPID")
