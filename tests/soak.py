"""Run random faults for a long time, and report the messages sent, received and lost, and the memory used.

    make soak SOAK_MINUTES=30

The gateway is another process, so that its memory can be measured; the simulator and a subscriber are
in this one. Each round begins and ends one fault; then data must flow again.
"""

import argparse
import asyncio
import json
import platform
import random
import statistics
import sys
import tempfile
import time
from collections import Counter, defaultdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import uvloop
from rich.console import Console

from gateway import version_text
from gateway.messages.decode import decode
from gateway.outputs.zenoh.subscriber import ZenohSubscriber, key_pattern, open_zenoh
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.simulator.faults.control import Faults
from gateway.simulator.faults.kinds import KINDS
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_port
from tests.waiting import wait_until_async

RATE_HZ: Final = 200.0
COMPONENTS: Final = tuple(COMPONENTS_BY_KEY)
BACKOFF_S: Final = 0.5
STALL_S: Final = 1.0
RECOVERY_LIMIT_S: Final = 30.0
BEGIN, END = "<!-- soak: begin -->", "<!-- soak: end -->"
"""The lines around the report in its file."""


class ReceivedMessages:
    """Counts of the messages that the subscriber received; Zenoh's thread calls ``count``."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.gaps: Counter[str] = Counter()
        self.malformed = 0
        self.repeated = 0
        self.status: Any = None
        self._sequence: dict[str, int] = {}

    def count(self, key: str, message: bytes) -> None:
        component = key.rsplit("/", 1)[-1]
        if component in COMPONENTS or component == "status":
            try:
                decoded = decode(message)
            except Exception:  # noqa: BLE001 - any error means a malformed message, which is counted
                self.malformed += 1
                return
            # The first sequence can be any: the gateway does not wait for this subscriber.
            expected = self._sequence.get(component, decoded.sequence - 1) + 1
            if decoded.sequence < expected:
                self.repeated += 1
            self.gaps[component] += max(0, decoded.sequence - expected)
            self._sequence[component] = max(expected, decoded.sequence)
            self.received[component] += 1
            if component == "status":
                self.status = decoded


class Soak:
    """One run. ``rounds`` has the kind of each fault and its recovery time in s, None without recovery."""

    def __init__(self, minutes: float, seed: int) -> None:
        self.minutes = minutes
        self.seed = seed
        self.random = random.Random(seed)
        self.messages = ReceivedMessages()
        self.rounds: list[tuple[str, float | None]] = []
        self.memory_kib: list[int] = []
        self.sent: Counter[str] = Counter()

    async def run(self, console: Console) -> None:
        """Run for ``minutes`` and print a line after each round."""
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        scene = SyntheticScene(
            markers=20, tools=3, analog=8, plates=1, rate_hz=RATE_HZ, analog_rate_hz=RATE_HZ
        )
        async with Simulator(scene, port=free_port()) as simulator:
            with tempfile.TemporaryDirectory() as folder:
                config = Path(folder) / "gateway.json"
                config.write_text(json.dumps(_configuration(simulator.port, endpoint, folder)))
                gateway = await asyncio.create_subprocess_exec(
                    sys.executable, "-m", "gateway", "run", "--config", str(config), "--log-level", "error"
                )
                try:
                    await self._run(simulator, gateway.pid, endpoint, console)
                finally:
                    gateway.terminate()
                    await gateway.wait()

    async def _run(self, simulator: Simulator, pid: int, endpoint: str, console: Console) -> None:
        session = await _open(endpoint)
        ZenohSubscriber(session, key_pattern("mocap", "lab", None), self.messages.count)
        faults = simulator.faults
        end_s = time.monotonic() + 60 * self.minutes
        try:
            await wait_until_async(lambda: self.messages.received["3d"] > RATE_HZ, 20)
            self.memory_kib.append(_memory_kib(pid))
            while time.monotonic() < end_s:
                await self._round(faults)
                self.memory_kib.append(_memory_kib(pid))
                kind, recovery_s = self.rounds[-1]
                recovered = (
                    "did not recover" if recovery_s is None else f"data again after {recovery_s:.2f} s"
                )
                left_s = max(0.0, end_s - time.monotonic())
                console.print(
                    f"{left_s:6.0f} s left, round {len(self.rounds):4}: {kind:24} {recovered}; "
                    f"{self.messages.received['3d']} frames, {self.memory_kib[-1] / 1024:.1f} MiB"
                )
            simulator.stop_measurement()
            await asyncio.sleep(2)
            self.sent = simulator.components_sent
        finally:
            await faults.clear()
            session.close()

    async def _round(self, faults: Faults) -> None:
        kind = self.random.choice(sorted(KINDS))
        faults.begin(KINDS[kind].model_validate({}))
        await asyncio.sleep(self.random.uniform(0.3, 3.0))
        await faults.clear()
        before = self.messages.received["3d"]
        cleared_s = time.monotonic()
        try:
            # Frames sent during the fault may still be in transit.
            await wait_until_async(lambda: self.messages.received["3d"] > before + 20, RECOVERY_LIMIT_S)
        except AssertionError:
            self.rounds.append((kind, None))
        else:
            self.rounds.append((kind, time.monotonic() - cleared_s))

    def report(self) -> str:
        """Return the report for docs/reliability.md."""
        messages, status = self.messages, self.messages.status
        stream = status.streams[0]
        start_kib, end_kib = self.memory_kib[0], self.memory_kib[-1]
        lines = [
            f"Random faults for {self.minutes:g} minutes at {RATE_HZ:g} Hz (`make soak SOAK_MINUTES="
            f"{self.minutes:g}`, seed {self.seed}), {datetime.now(UTC):%Y-%m-%d}, version {version_text()}, "
            f"Python {platform.python_version()}, uvloop {version('uvloop')}, {platform.machine()}. "
            "Each round starts one fault of the simulator (see `rtc3d-gateway simulate --list-faults`), "
            "ends it 0.3 to 3 s later, and waits until data flows again. "
            f"The gateway's stall_timeout_s is {STALL_S:g} and its reconnect.max_delay_s is {BACKOFF_S:g}.",
            "",
            "| what | count |",
            "|---|--:|",
            f"| rounds | {len(self.rounds)} |",
            f"| rounds after which no data flowed | {sum(r is None for _, r in self.rounds)} |",
            f"| reconnects | {stream.reconnects} |",
            f"| malformed messages | {messages.malformed} |",
            f"| messages received twice | {messages.repeated} |",
            f"| memory at the start, MiB | {start_kib / 1024:.1f} |",
            f"| memory at the end, MiB | {end_kib / 1024:.1f} |",
            f"| peak memory, MiB | {max(self.memory_kib) / 1024:.1f} |",
            "",
            "Frames that the simulator sent and messages that the subscriber received, by component. Lost "
            "frames were in transit on connections that a fault ended, or are counted as drops below. A gap "
            "is a sequence number that was lost between gateway and subscriber.",
            "",
            "| component | sent | received | lost | gaps |",
            "|---|--:|--:|--:|--:|",
            *(
                f"| {key} | {self.sent[key]} | {messages.received[key]} | "
                f"{self.sent[key] - messages.received[key]} | {messages.gaps[key]} |"
                for key in COMPONENTS
            ),
            "",
            "| lost, by cause | messages | frames |",
            "|---|--:|--:|",
            *(f"| {loss.cause} | {loss.messages} | {loss.frames} |" for loss in stream.drops),
            *(
                f"| {output.name}: {loss.cause} | {loss.messages} | {loss.frames} |"
                for output in status.outputs
                for loss in output.drops
            ),
            "",
            "The time from the end of a fault until data flowed again. It includes the time that the gateway "
            "took to notice the fault and waited to reconnect:",
            "",
            "| fault | rounds | median s | longest s |",
            "|---|--:|--:|--:|",
        ]
        by_kind: dict[str, list[float]] = defaultdict(list)
        for kind, recovery_s in self.rounds:
            by_kind[kind].append(RECOVERY_LIMIT_S if recovery_s is None else recovery_s)
        lines += [
            f"| {kind} | {len(times)} | {statistics.median(times):.2f} | {max(times):.2f} |"
            for kind, times in sorted(by_kind.items())
        ]
        return "\n".join(lines) + "\n"


def _configuration(port: int, endpoint: str, folder: str) -> dict[str, Any]:
    return {
        "sources": [
            {
                "name": "lab",
                "host": "127.0.0.1",
                "port": port,
                "reconnect": {"first_delay_s": 0.1, "max_delay_s": BACKOFF_S},
                "stall_timeout_s": STALL_S,
                "reply_timeout_s": 0.5,
            }
        ],
        "spool": {"directory": folder},
        "zenoh": {
            "config": {"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        },
        "lcm": {"enabled": False},
    }


async def _open(endpoint: str) -> Any:
    for _ in range(100):
        try:
            return await asyncio.to_thread(open_zenoh, endpoint)
        except Exception:  # noqa: BLE001 - the gateway does not listen yet
            await asyncio.sleep(0.1)
    raise SystemExit(f"no gateway at {endpoint}")


def _memory_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise SystemExit("the gateway has ended")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", type=Path, help="the file to put the report into; by default, print it")
    options = parser.parse_args()
    soak = Soak(options.minutes, options.seed)
    uvloop.run(soak.run(Console()))
    if options.report:
        before, _, rest = options.report.read_text().partition(BEGIN)
        _, _, after = rest.partition(END)
        options.report.write_text(f"{before}{BEGIN}\n\n{soak.report()}\n{END}{after}")
        print(f"report in {options.report}")
    else:
        print(soak.report())
    if any(recovery_s is None for _, recovery_s in soak.rounds):
        sys.exit("after some faults, data did not flow again")


if __name__ == "__main__":
    main()
