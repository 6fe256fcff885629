"""A gateway with a healthy source and attackers, and a report of what the healthy source suffered.

An attack is a test of about ten lines. The server, the asker or the subscriber that attacks is in the test:

    pytestmark = pytest.mark.netns

    async def flood(client: Client) -> None:
        while True:
            client.send(b"HTTP/1.1 200 OK\\r\\n" * 1000)
            await client.drain()

    async def test_endless_text(gateway_under_attack: GatewayUnderAttack) -> None:
        async with ScriptedServer(flood) as server, gateway_under_attack({"hostile": server.port}) as gateway:
            await asyncio.sleep(3)  # the length of the attack
        gateway.report.check()

The healthy source is called ``healthy``: a simulator at 200 Hz with all components, one for all tests. The
measurement begins when its frames arrive at a subscriber on Zenoh and at one on LCM, and ends with the block.
Several attackers can share a gateway. Askers and further subscribers connect to ``gateway.zenoh_endpoint``
and ``gateway.lcm_url``. At the end of the run, pytest prints the figures of all attacks. On a quiet machine,
``HOSTILE_MAX_SILENCE_S=0.1`` checks the real limit.
"""

import asyncio
import contextlib
import json
import math
import os
import re
import signal
import sys
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import yaml

from tests.hostile.recorder import FRAME_COMPONENTS
from tests.support.gateway_process import PROGRAM
from tests.support.networks import free_port, lcm_url, zenoh_keys

HEALTHY_SCENE: Final = ("--rate", "200", "--analog-rate", "200")
"""The options of ``simulate`` for the healthy source."""

MAX_SILENCE_S: Final = float(os.environ.get("HOSTILE_MAX_SILENCE_S", "inf"))
"""By default, silences are only reported: other work on the computer causes them, too."""

MAX_LOG_LINES_PER_MINUTE: Final = 100
MAX_STOP_S: Final = 20.0
"""The gateway stops within 2 s; a busy machine may take longer. What hangs takes longer than this."""

_START_TIMEOUT_S: Final = 60.0
_STOP_TIMEOUT_S: Final = 30.0

ATTACKER: Final = {
    "host": "127.0.0.1",
    "reconnect": {"first_delay_s": 0.1, "max_delay_s": 0.5},
    "connect_timeout_s": 1.0,
    "reply_timeout_s": 0.5,
    "stall_timeout_s": 1.0,
}
"""The settings of a source that is given as a port: short delays, so that an attack is often repeated."""

Source = int | Mapping[str, Any]
"""The port of an attacker, or settings of its source that are added to ATTACKER."""


@dataclass(frozen=True)
class Report:
    """What happened to the healthy source and the gateway.

    ``arrivals`` has the figures of the recorder's ``Outputs.report``.
    """

    arrivals: dict[str, Any]
    rss_before_kib: int
    rss_after_kib: int
    exit_status: int | None
    """The status of the gateway after SIGTERM. None if it had to be killed."""
    ended_early: bool
    """Whether the gateway had ended before SIGTERM."""
    stop_s: float
    log: str = field(repr=False)
    sources: Sequence[str]
    """The names of the attackers."""

    @property
    def longest_silence_s(self) -> dict[str, float]:
        """The longest time without a message of some component, by output."""
        return longest_silence_s(self.arrivals)

    @property
    def num_missing(self) -> int:
        """How many messages are missing, by their sequence or frame numbers, at both subscribers together."""
        return num_missing(self.arrivals)

    @property
    def num_received(self) -> int:
        return int(_total(self.arrivals, "received"))

    @property
    def num_reconnects(self) -> int:
        """How often the gateway connected to the healthy server again."""
        return int(max(self.arrivals["zenoh"][key]["reconnects"] for key in FRAME_COMPONENTS))

    @property
    def log_lines_per_minute(self) -> int:
        """The largest number of lines logged in a minute about one source, or about none."""
        return log_lines_per_minute(self.log, self.sources)

    def problems(self) -> list[str]:
        """Return what the attack did to others, in sentences."""
        found = [
            f"{output} was silent for {silence_s:.3f} s"
            for output, silence_s in self.longest_silence_s.items()
            if silence_s > MAX_SILENCE_S
        ]
        if self.num_missing:
            found.append(f"{self.num_missing} messages of the healthy source are missing")
        if _total(self.arrivals, "repeated"):
            found.append("messages of the healthy source came twice")
        if self.num_reconnects:
            found.append(f"the gateway connected to the healthy server again, {self.num_reconnects} times")
        if self.ended_early:
            found.append(f"the gateway ended with status {self.exit_status} during the attack")
        elif self.exit_status is None:
            found.append(f"the gateway did not stop within {_STOP_TIMEOUT_S:g} s and was killed")
        elif self.exit_status:
            found.append(f"the gateway ended with status {self.exit_status} after SIGTERM")
        elif self.stop_s > MAX_STOP_S:
            found.append(f"the gateway took {self.stop_s:.1f} s to stop")
        if self.log_lines_per_minute > MAX_LOG_LINES_PER_MINUTE:
            found.append(f"{self.log_lines_per_minute} lines about one source were logged in a minute")
        return found

    def check(self, max_growth_mib: float = math.inf) -> None:
        """Fail the test if the attack did anything to the healthy source or the process."""
        problems = self.problems()
        if (growth_mib := (self.rss_after_kib - self.rss_before_kib) / 1024) > max_growth_mib:
            problems.append(f"the memory grew by {growth_mib:.0f} MiB")
        assert not problems, "; ".join(problems) + f"\n{self}\nThe last lines of the log:\n{self.log[-4000:]}"

    def __str__(self) -> str:
        silences = ", ".join(f"{output} {value:.3f} s" for output, value in self.longest_silence_s.items())
        return (
            f"longest silence {silences} (recorder {self.arrivals['recorder_pause_s']:.3f} s, "
            f"{self.arrivals['recorder_dropped']} dropped); "
            f"{self.num_missing} of {self.num_received} missing; {self.log_lines_per_minute} lines/min; "
            f"{self.rss_before_kib / 1024:.0f} → {self.rss_after_kib / 1024:.0f} MiB; "
            f"status {self.exit_status} after {self.stop_s:.2f} s"
        )


def merge(earlier: Any, later: Any) -> Any:
    """Return the arrivals of two periods together: the sums of the counts and the longer times."""
    if isinstance(later, dict):
        return {key: merge(earlier[key], value) for key, value in later.items()}
    return max(earlier, later) if isinstance(later, float) else earlier + later


def longest_silence_s(arrivals: Mapping[str, Any]) -> dict[str, float]:
    """Return the longest time without a message of some component, by output."""
    return {
        output: max(arrivals[output][component]["longest_silence_s"] for component in FRAME_COMPONENTS)
        for output in ("zenoh", "lcm")
    }


def num_missing(arrivals: Mapping[str, Any]) -> int:
    """Return how many messages are missing at both subscribers together.

    A message lost behind the gateway is missing in both numbers, a frame lost before it only in the second.
    On LCM, what the recorder itself does not read in time is not the gateway's loss.
    """
    by_output: dict[str, int] = {
        output: sum(
            max(report["missing_messages"], report["missing_frames"] if component in FRAME_COMPONENTS else 0)
            for component, report in arrivals[output].items()
        )
        for output in ("zenoh", "lcm")
    }
    return by_output["zenoh"] + max(0, by_output["lcm"] - int(arrivals["recorder_dropped"]))


def _total(arrivals: Mapping[str, Any], what: str) -> float:
    return sum(float(report[what]) for output in ("zenoh", "lcm") for report in arrivals[output].values())


def log_lines_per_minute(log: str, sources: Sequence[str]) -> int:
    """Return the largest number of lines within 60 s about one source, or about none.

    A line without a time, as of a traceback, belongs to the line before.
    """
    recent: defaultdict[str, deque[float]] = defaultdict(deque)
    worst, time_s, source = 0, 0.0, ""
    for line in log.splitlines():
        words = re.split(r"[ :]", line[23:].lstrip(), maxsplit=2)
        with contextlib.suppress(ValueError):
            time_s = datetime.strptime(line[:23], "%Y-%m-%d %H:%M:%S,%f").timestamp()  # noqa: DTZ007 - local
            source = words[1] if len(words) > 1 and words[1] in sources else ""
        times = recent[source]
        times.append(time_s)
        while times[0] < time_s - 60:
            times.popleft()
        worst = max(worst, len(times))
    return worst


def rss_kib(process_id: int) -> int:
    """Return the memory of a process; 0 if it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process_id}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1])
    return 0


class RunningGateway:
    """A gateway under attack. ``report`` is set at the end of the attack."""

    report: Report

    def __init__(self, folder: Path, healthy_port: int, metrics_port: int) -> None:
        self.folder = folder
        self.healthy_port = healthy_port
        self.zenoh_endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.lcm_url = lcm_url()
        self.metrics_port = metrics_port
        self.config = folder / "gateway.yaml"
        """Its configuration; to reload it, write it and send SIGHUP to ``process``."""
        self._log = folder / "gateway.log"
        self._arrivals: dict[str, Any] = {}
        self.process: Process
        self._recorder: Process

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def rss_kib(self) -> int:
        return rss_kib(self.process.pid)

    async def stop_for(self, seconds: float) -> None:
        """Stop the process for a while."""
        self.process.send_signal(signal.SIGSTOP)
        await asyncio.sleep(seconds)
        self.process.send_signal(signal.SIGCONT)

    async def arrivals(self) -> dict[str, Any]:
        """Return what arrived since the last call, or since the beginning, as in ``Report.arrivals``."""
        stdin, stdout = self._recorder.stdin, self._recorder.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(b"report\n")
        arrivals: dict[str, Any] = json.loads(await asyncio.wait_for(stdout.readline(), _STOP_TIMEOUT_S))
        self._arrivals = merge(self._arrivals, arrivals) if self._arrivals else arrivals
        return arrivals

    async def all_arrivals(self) -> dict[str, Any]:
        """Return what arrived since the beginning."""
        await self.arrivals()
        return self._arrivals

    def write_config(self, attackers: Mapping[str, Source], settings: Mapping[str, Any]) -> None:
        """Write the configuration with these attackers; ``settings`` are merged into its sections."""
        configuration: dict[str, Any] = {
            "sources": [
                {"name": "healthy", "host": "127.0.0.1", "port": self.healthy_port},
                *(
                    {"name": name, **ATTACKER, **({"port": source} if isinstance(source, int) else source)}
                    for name, source in attackers.items()
                ),
            ],
            "spool": {"directory": str(self.folder / "spool")},
            # It fills soon, so that its growth is not that of an attack.
            "history": {"max_bytes": 8 * 1024 * 1024},
            "zenoh": {"config": zenoh_keys("peer", listen=self.zenoh_endpoint)},
            "lcm": {"url": self.lcm_url},
            "metrics": {"port": self.metrics_port},
        }
        for section, values in settings.items():
            configuration[section] = {**configuration.get(section, {}), **values}
        self.config.write_text(yaml.safe_dump(configuration))

    async def start(self, environ: Mapping[str, str], before_command: Sequence[str] = ()) -> None:
        """Start the gateway and the recorder, and wait until frames arrive."""
        environment = {**os.environ, **environ}
        with self._log.open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *(*before_command, *PROGRAM, "run", "--config", str(self.config)),
                env=environment,
                stdin=DEVNULL,
                stderr=log,
            )
        self._recorder = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.hostile.recorder", "healthy", self.zenoh_endpoint, self.lcm_url),
            stdin=PIPE,
            stdout=PIPE,
        )
        assert self._recorder.stdout is not None
        try:
            line = await asyncio.wait_for(self._recorder.stdout.readline(), _START_TIMEOUT_S)
        except TimeoutError:
            line = b""
        assert line, f"no frames of the healthy source within {_START_TIMEOUT_S:g} s:\n{self.log[-4000:]}"

    async def stop(self) -> tuple[int | None, bool, float]:
        """Send SIGTERM; return the exit status, whether it had ended before, and how long it took in s."""
        ended_early = self.process.returncode is not None
        stopped_s = time.monotonic()
        if not ended_early:
            self.process.terminate()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self.process.wait(), _STOP_TIMEOUT_S)
        return self.process.returncode, ended_early, time.monotonic() - stopped_s

    async def kill(self) -> None:
        """End both processes."""
        for process in (getattr(self, "process", None), getattr(self, "_recorder", None)):
            if process is not None and process.returncode is None:
                process.kill()
                await process.wait()


@contextlib.asynccontextmanager
async def python(*arguments: str, **options: Any) -> AsyncIterator[Process]:
    """Run a Python program until the end of the block."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, **{"stdin": PIPE, "stdout": PIPE, **options}
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def printed(process: Process) -> None:
    """Wait until a program has printed a line."""
    assert process.stdout is not None
    assert await process.stdout.readline()


GatewayUnderAttack = Callable[..., AbstractAsyncContextManager[RunningGateway]]
"""The fixture ``gateway_under_attack``: ``run_gateway`` without its first two arguments."""


@contextlib.asynccontextmanager
async def run_gateway(
    folder: Path,
    healthy_port: int,
    attackers: Mapping[str, Source] | None = None,
    settings: Mapping[str, Any] | None = None,
    environ: Mapping[str, str] | None = None,
    before_command: Sequence[str] = (),
) -> AsyncIterator[RunningGateway]:
    """Run a gateway until the end of the block, and set its ``report``.

    ``attackers`` are sources by name. ``settings`` are merged into the sections of the configuration, such as
    {"lcm": {"url": "tcpq://127.0.0.1:7700"}}. ``environ`` is added to the environment. ``before_command``
    stands before the command of the gateway, such as that of ``dead_name_server``; it must exec the gateway.
    """
    gateway = RunningGateway(folder, healthy_port, free_port())
    gateway.write_config(attackers or {}, settings or {})
    try:
        await gateway.start(environ or {}, before_command)
        rss_before_kib = gateway.rss_kib()
        yield gateway
        arrivals = await gateway.all_arrivals()
        rss_after_kib = gateway.rss_kib()
        exit_status, ended_early, stop_s = await gateway.stop()
        gateway.report = Report(
            arrivals,
            rss_before_kib,
            rss_after_kib,
            exit_status,
            ended_early,
            stop_s,
            gateway.log,
            tuple(attackers or ()),
        )
    finally:
        await gateway.kill()
