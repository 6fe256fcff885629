"""A gateway and a simulator as processes of their own, and a Zenoh subscriber to all components."""

import contextlib
import os
import signal
import struct
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from gateway.messages.decode import decode
from tests.support.configurations import write_config
from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.support.waiting import wait_until

PROGRAM: Final = (sys.executable, "-m", "gateway")

_HEADER: Final = struct.Struct(">8xqqqiii")  # fingerprint, prefix, frame number


class Header(NamedTuple):
    """The beginning of a component message: its prefix and its frame number."""

    utime: int
    capture_utime: int
    sequence: int
    session: int
    parameters_version: int
    frame_number: int


class GatewayProcess:
    """A running gateway with the source lab. ``headers`` are those received so far, by component."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path, endpoint: str) -> None:
        self.process = process
        self.endpoint = endpoint
        """Where its Zenoh session, and other subscribers, connect to."""
        self._log = log
        self.headers: defaultdict[str, list[Header]] = defaultdict(list)
        self.statuses: list[Any] = []

    def receive(self, sample: zenoh.Sample) -> None:
        component = str(sample.key_expr).rpartition("/")[2]
        message = sample.payload.to_bytes()
        if component == "status":
            self.statuses.append(decode(message))
        elif component in {"3d", "6d", "analog", "force", "event"}:
            self.headers[component].append(Header(*_HEADER.unpack_from(message)))

    @property
    def log(self) -> str:
        return self._log.read_text()

    def stop_for(self, seconds: float) -> None:
        """Stop the process for a while."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED)
        time.sleep(seconds)
        self.process.send_signal(signal.SIGCONT)

    def wait_for_clock(self) -> None:
        """Wait until the gateway knows the clock of the server."""
        wait_until(lambda: self.statuses and self.statuses[-1].streams[0].clock.has_clock)

    def wait_for_frames(self, count: int) -> None:
        """Wait for ``count`` further frames."""
        before = len(self.headers["3d"])
        wait_until(lambda: len(self.headers["3d"]) >= before + count)


@contextlib.contextmanager
def program(*arguments: str, environ: Mapping[str, str] | None = None, **options: Any) -> Iterator[Any]:
    """Run rtc3d-gateway until the end of the block."""
    environment = {**os.environ, **(environ or {})}
    with subprocess.Popen([*PROGRAM, *arguments], env=environment, **options) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGCONT)
            process.kill()


@contextlib.contextmanager
def simulator(*options: str, log: Path = Path(os.devnull)) -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """Run ``simulate`` with these options; yield its port and its process."""
    arguments = ("simulate", "--port", "0", *options)
    with (
        log.open("w") as stderr,
        program(*arguments, stdout=subprocess.PIPE, stderr=stderr, text=True) as process,
    ):
        line = process.stdout.readline()
        yield int(line.partition(";")[0].rpartition(":")[2]), process


@contextlib.contextmanager
def gateway_process(
    folder: Path,
    port: int,
    environ: Mapping[str, str] | None = None,
    hub: str = "peer",
    lcm_url: str | None = None,
    **source: Any,
) -> Iterator[GatewayProcess]:
    """Run a gateway on Zenoh, with default settings except for those of the ``source``.

    Its subscriber is a peer; with "router" as the ``hub``, other programs can connect to it, too. With an
    ``lcm_url``, it also publishes on LCM.
    """
    endpoint = free_endpoint()
    sections = {
        "zenoh": {"config": zenoh_keys("peer", connect=endpoint)},
        "lcm": {"enabled": lcm_url is not None, "url": lcm_url},
    }
    config = write_config(folder / "gateway.yaml", port, source=source, **sections)
    log = folder / "gateway.log"
    with contextlib.ExitStack() as stack:
        session = open_zenoh(hub, listen=endpoint)
        stack.callback(session.close)
        file = stack.enter_context(log.open("wb"))
        process = stack.enter_context(program("run", "--config", str(config), environ=environ, stderr=file))
        gateway = GatewayProcess(process, log, endpoint)
        session.declare_subscriber("mocap/lab/*", gateway.receive)
        yield gateway


def gaps(numbers: list[int]) -> list[tuple[int, int]]:
    """Return the pairs of successive numbers that do not follow each other."""
    return [(before, after) for before, after in pairwise(numbers) if after != before + 1]
