"""``record`` as a program of its own, and a gateway beside it, on real Zenoh and LCM."""

import os
import re
import resource
import signal
import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
import zenoh

from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.takes.files.event_log import EventLogReader
from tests.support.gateway_process import PROGRAM, program, simulator
from tests.support.networks import free_endpoint, lcm_url, open_zenoh, wait_for_zenoh, zenoh_keys
from tests.support.waiting import wait_until

SCENE: Final = ("--rate", "100", "--analog-rate", "500", "--markers", "20", "--analog", "8", "--tools", "2")
COMPONENTS: Final = ("3d", "6d", "analog", "force", "event")
MARKERS: Final = "MOCAP_LAB_1_3D"

_TAIL_BYTES: Final = 8 * 1024 * 1024


class Ended(NamedTuple):
    status: int
    stdout: str
    stderr: str


class RecordProcess:
    """A running ``record``."""

    def __init__(self, process: subprocess.Popen[str], stderr: Path) -> None:
        self.process = process
        self._stderr = stderr

    def has_reported(self, text: str) -> bool:
        """Whether this was printed on stderr."""
        return text in self._stderr.read_text()

    def wait_for(self, text: str) -> None:
        """Wait until this was printed on stderr."""
        wait_until(lambda: self.has_reported(text))

    def limit_files(self, num_bytes: int) -> None:
        """Let the kernel refuse longer files, as on a full disk."""
        _, hard = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (num_bytes, hard))

    def end(self, number: signal.Signals | None = signal.SIGINT) -> Ended:
        """Wait for the end of the program, after a signal if given."""
        if number is not None:
            self.process.send_signal(number)
        stdout, _ = self.process.communicate(timeout=120)
        stderr = self._stderr.read_text()
        assert "Traceback" not in stderr + stdout
        assert "defect" not in stderr
        return Ended(self.process.returncode, stdout, stderr)


@contextmanager
def recording(target: Path, *options: str, command: tuple[str, ...] = PROGRAM) -> Iterator[RecordProcess]:
    """Run ``record`` to a file or folder until the end of the block; its messages are beside it."""
    stderr = target.parent / "stderr"
    environment = os.environ | {"COLUMNS": "200"}
    with (
        stderr.open("w") as file,
        subprocess.Popen(
            [*command, "record", str(target), *options],
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
            env=environment,
        ) as process,
    ):
        try:
            yield RecordProcess(process, stderr)
        finally:
            process.kill()


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def num_recorded(path: Path, channel: str) -> int:
    """Return how many messages of a channel a recording has so far."""
    return path.read_bytes().count(channel.encode()) if path.exists() else 0


def events(path: Path) -> list[tuple[str, bytes]]:
    """Return the channels and messages of a file, which must not be damaged."""
    reader = EventLogReader(path)
    found = [(event.channel, event.message) for event in reader.events()]
    assert not reader.damage
    return found


def by_channel(path: Path) -> dict[str, list[bytes]]:
    found: defaultdict[str, list[bytes]] = defaultdict(list)
    for channel, message in events(path):
        found[channel].append(message)
    return found


class Lab(NamedTuple):
    """A gateway process with the source Lab-1. ``published`` is what another subscriber got, by channel."""

    options: tuple[str, ...]
    published: dict[str, list[bytes]]
    server: subprocess.Popen[str]
    restart: Callable[[], None]
    """Ends the gateway by SIGTERM and starts another one."""


@contextmanager
def lab(
    folder: Path,
    side: str = "zenoh",
    *scene: str,
    router: str | None = None,
    history_s: float = 60.0,
    has_tool_poses: bool = True,
    **source: Any,
) -> Iterator[Lab]:
    """Run a gateway, which also connects to a ``router`` on Zenoh if there is one."""
    endpoint, url = free_endpoint(), lcm_url()
    published: defaultdict[str, list[bytes]] = defaultdict(list)

    def receive_zenoh(sample: zenoh.Sample) -> None:
        path = str(sample.key_expr).split("/", 2)[2]
        label = path.removeprefix("6d/").replace("%20", " ")
        names = ("6d", label) if path.startswith("6d/") else (path,)
        published[lcm_channel("MOCAP", "Lab-1", *names)].append(sample.payload.to_bytes())

    with ExitStack() as stack:
        port, server = stack.enter_context(simulator(*SCENE, *scene))
        keys = zenoh_keys("peer", listen=endpoint, connect=router)
        configuration = {
            "sources": [{"name": "Lab-1", "host": "127.0.0.1", "port": port, **source}],
            "zenoh": {"enabled": side == "zenoh", "tool_poses": has_tool_poses, "config": keys},
            "lcm": {"enabled": side == "lcm", "tool_poses": has_tool_poses, "url": url},
            "metrics": {"enabled": False},
            "history": {"seconds": history_s},
        }
        (folder / "gateway.yaml").write_text(yaml.safe_dump(configuration))
        gateways: list[subprocess.Popen[bytes]] = []

        def start() -> None:
            gateway = program("run", "--config", str(folder / "gateway.yaml"), stderr=subprocess.DEVNULL)
            gateways.append(stack.enter_context(gateway))

        def restart() -> None:
            gateways[-1].terminate()
            gateways[-1].wait(timeout=60)
            start()

        start()
        if side == "zenoh":
            session = wait_for_zenoh(endpoint)
            stack.callback(session.close)
            session.declare_subscriber("mocap/Lab-1/**", receive_zenoh)
            options: tuple[str, ...] = ("--connect", endpoint)
        else:
            receive = lambda channel, data: published[channel].append(data)  # noqa: E731
            stack.callback(LcmSubscriber(open_lcm(receiving_url(url)), "MOCAP_.+", receive).close)
            options = ("--lcm", "--url", url)
        wait_until(lambda: len(published[lcm_channel("MOCAP", "Lab-1", "3d")]) > 10)
        yield Lab(options, published, server, restart)


def assert_same_bytes(path: Path, published: dict[str, list[bytes]]) -> None:
    """The file has every message from its first one to its last one, with the bytes that were published."""
    recorded = by_channel(path)
    for name in (*COMPONENTS, "status", "clock", "6d_TOOL_1", "6d_TOOL_2"):
        channel = f"MOCAP_LAB_1_{name.upper()}"
        messages = recorded[channel]
        assert messages, name
        start = published[channel].index(messages[0])
        wait_until(lambda: len(published[channel]) >= start + len(messages))  # noqa: B023
        assert published[channel][start : start + len(messages)] == messages


def refilled(ended: Ended) -> int:
    """Return how many messages with markers were refilled, according to the table."""
    match = re.search(r"^Lab-1 +3d .* Hz +(\S+) +\S+ +\S+$", ended.stdout, re.MULTILINE)
    assert match is not None, ended
    return 0 if match[1] == "-" else int(match[1])


def wait_for_frames(gateway: Lab, number: int) -> None:
    """Wait until the gateway has published so many more frames."""
    until = len(gateway.published[MARKERS]) + number
    wait_until(lambda: len(gateway.published[MARKERS]) >= until)


def wait_until_it_hears_everything(path: Path) -> None:
    """Wait until a recording has the last of what comes once a second, and some frames."""
    wait_until(lambda: num_recorded(path, "MOCAP_LAB_1_CLOCK") > 0 and num_recorded(path, MARKERS) > 20)


def wait_until_recorded(path: Path, message: bytes) -> None:
    """Wait until a message is at the end of a recording."""
    wait_until(lambda: is_recorded(path, message))


def is_recorded(path: Path, message: bytes) -> bool:
    """Whether a message is at the end of a recording, which may be too long to be read again and again."""
    with path.open("rb") as file:
        file.seek(max(0, size(path) - _TAIL_BYTES))
        return message in file.read()


def record_past(path: Path, gateway: Lab, options: tuple[str, ...], disturb: Callable[[int], None]) -> Ended:
    """Record some frames, ``disturb`` the process with this id, and record what follows."""
    with recording(path, *options) as record:
        wait_until_it_hears_everything(path)
        disturb(record.process.pid)
        wait_until_recorded(path, gateway.published[MARKERS][-1])
        return record.end()


@contextmanager
def stoppable_router(endpoint: str) -> Iterator[list[zenoh.Session]]:
    """Run a router; a test may close it and put another one into the list."""
    routers = [open_zenoh("router", listen=endpoint)]
    try:
        yield routers
    finally:
        routers[-1].close()
