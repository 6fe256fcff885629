"""One run: rounds of faults and attacks, what subscribers receive, and the memory of the gateway.

The gateway has four kinds of sources: ``lab``, a simulator in this process with faults; ``healthy``, a
simulator that nothing disturbs, in another process; ``tools``, one with hundreds of tools; and sources whose
servers are attackers. All outputs are on. In each round, the gateway reloads a configuration with or without
one more source and with other names on ROS 2, and one fault and one attack begin and end; then data of
``lab`` must flow again.
"""

import asyncio
import json
import random
import signal
import sys
import tempfile
import time
from asyncio.subprocess import DEVNULL
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from gateway.messages.decode import decode
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber, key_patterns, open_zenoh
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.simulator.simulator import KINDS, Faults, Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.hostile.gateway_under_attack import (
    HEALTHY_SCENE,
    Report,
    RunningGateway,
    Source,
    log_lines_per_minute,
    longest_silence_s,
    num_missing,
    rss_kib,
    run_gateway,
)
from tests.soak.attacks import ATTACKS, Target
from tests.support.gateway_process import simulator as simulator_process
from tests.support.lsl_receiver import lsl_config
from tests.support.networks import dead_name_server, free_endpoint, free_port
from tests.support.networks import open_zenoh as open_session
from tests.support.waiting import wait_until_async

RATE_HZ: Final = 200.0
COMPONENTS: Final = tuple(COMPONENTS_BY_KEY)
BACKOFF_S: Final = 0.5
STALL_S: Final = 1.0
RECOVERY_LIMIT_S: Final = 30.0
FAULT_S: Final = (0.3, 3.0)
NUM_TOOLS: Final = 300
TOOLS_SCENE: Final = ("--markers", "0", "--tools", str(NUM_TOOLS), "--rate", "10", "--analog-rate", "10")
"""A source with tools by the hundred; each has a key of its own."""

ATTACK_START_S: Final = 1.0
"""How long the process of an attack takes to start."""

HOSTILE: Final = ("hostile-1", "hostile-2")
"""The sources whose servers attack."""

MAX_SILENCE_S: Final = 0.1
"""The longest silence that an attack may cause, on an otherwise idle machine."""


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


class Usage(NamedTuple):
    """What a process uses."""

    memory_kib: int
    threads: int
    descriptors: int

    @classmethod
    def of(cls, process_id: int) -> "Usage":
        """Return what a process uses now."""
        folder = Path(f"/proc/{process_id}")
        threads, descriptors = (len([*(folder / name).iterdir()]) for name in ("task", "fd"))
        return cls(rss_kib(process_id), threads, descriptors)


@dataclass(frozen=True)
class Round:
    """One fault and one attack, and what the healthy source suffered meanwhile."""

    fault: str
    attack: str
    recovery_s: float | None
    """How long after the end of both data of ``lab`` flowed again; None if it did not."""
    longest_silence_s: dict[str, float]
    """By output."""
    missing: int
    lines: int
    """The number of lines that were logged."""
    usage: Usage
    """What the gateway used at the end."""


class Soak:
    """One run of ``minutes``.

    ``gateway_report`` is about the whole run, ``start`` what the gateway used at its beginning.
    """

    gateway_report: Report
    start: Usage

    def __init__(self, minutes: float, seed: int) -> None:
        self.minutes = minutes
        self.seed = seed
        self.random = random.Random(seed)
        self.messages = ReceivedMessages()
        self.rounds: list[Round] = []
        self.sent: Counter[str] = Counter()
        self._attacks: list[str] = []
        self._reload: Callable[..., None]

    async def run(self, console: Console) -> None:
        """Run for ``minutes`` and print a line after each round."""
        scene = SyntheticScene(
            markers=20, tools=3, analog=8, plates=1, rate_hz=RATE_HZ, analog_rate_hz=RATE_HZ
        )
        ports = {name: free_port() for name in HOSTILE}
        output_ports = {name: free_port() for name in ("rtc3d", "vrpn", "foxglove")}
        router = open_session("router", listen=(ros_router := free_endpoint()))
        router.declare_subscriber("**", lambda _sample: None)
        with (
            tempfile.TemporaryDirectory() as folder,
            simulator_process(*HEALTHY_SCENE) as (healthy_port, _),
            simulator_process(*TOOLS_SCENE) as (tools_port, _),
        ):
            async with Simulator(scene, port=free_port()) as simulator:
                sources: dict[str, Source] = {
                    "lab": {
                        "port": simulator.port,
                        "reconnect": {"first_delay_s": 0.1, "max_delay_s": BACKOFF_S},
                        "stall_timeout_s": STALL_S,
                    },
                    **ports,
                    "tools": tools_port,
                    "dead-name": {"host": "dead.example.org"},
                    "nobody": free_port(),
                }
                settings: dict[str, dict[str, Any]] = {
                    name: {"enabled": True}
                    | ({"ports": {"healthy": port}} if name == "rtc3d" else {"port": port})
                    for name, port in output_ports.items()
                }
                settings["lsl"] = {"enabled": True, "config": str(lsl_config(Path(folder)))}
                settings["ros2"] = {"enabled": True, "connect": ros_router}
                settings["zenoh"] = {"tool_poses": True}
                settings["takes"] = {"enabled": True, "directory": f"{folder}/takes", "keep_last_s": 30}
                with dead_name_server(Path(folder)) as before_command:
                    async with run_gateway(
                        Path(folder),
                        healthy_port,
                        sources,
                        settings,
                        before_command=before_command,
                    ) as gateway:
                        self._reload = partial(_reload, gateway, sources, settings)
                        await self._run(simulator, gateway, output_ports, tuple(ports.values()), console)
                self.gateway_report = gateway.report
        router.close()

    async def _run(
        self,
        simulator: Simulator,
        gateway: RunningGateway,
        output_ports: Mapping[str, int],
        ports: tuple[int, ...],
        console: Console,
    ) -> None:
        target = Target(
            gateway.zenoh_endpoint,
            gateway.lcm_url,
            LcmSettings(url=gateway.lcm_url).effective_queries_url,
            gateway.metrics_port,
            output_ports,
            gateway.process.pid,
            ports,
        )
        session = await asyncio.to_thread(open_zenoh, gateway.zenoh_endpoint)
        ZenohSubscriber(session, key_patterns("mocap", "lab", None), self.messages.count)
        end_s = time.monotonic() + 60 * self.minutes
        try:
            await wait_until_async(lambda: self.messages.received["3d"] > RATE_HZ)
            self.start = Usage.of(gateway.process.pid)
            await gateway.arrivals()  # what came before the first round
            while time.monotonic() < end_s and gateway.process.returncode is None:
                await self._round(simulator.faults, gateway, target)
                left_s = max(0.0, end_s - time.monotonic())
                console.print(
                    f"{left_s:6.0f} s left, round {len(self.rounds):4}: {_line(self.rounds[-1])}",
                    soft_wrap=True,
                )
            simulator.stop_measurement()
            await asyncio.sleep(2)
            self.sent = simulator.components_sent
        finally:
            await simulator.faults.clear()
            session.close()

    async def _round(self, faults: Faults, gateway: RunningGateway, target: Target) -> None:
        fault, attack = self.random.choice(sorted(KINDS)), self._next_attack()
        lines = gateway.log.count("\n")
        self._reload(is_odd=bool(len(self.rounds) % 2))
        async with _attacking(attack, target):
            await asyncio.sleep(ATTACK_START_S)
            faults.begin(KINDS[fault].model_validate({}))
            await asyncio.sleep(self.random.uniform(*FAULT_S))
            await faults.clear()
        before = self.messages.received["3d"]
        cleared_s = time.monotonic()
        recovery_s = None
        try:
            # Frames sent during the fault may still be in transit.
            await wait_until_async(lambda: self.messages.received["3d"] > before + 20, RECOVERY_LIMIT_S)
        except AssertionError:
            pass
        else:
            recovery_s = time.monotonic() - cleared_s
        arrivals = await gateway.arrivals()
        self.rounds.append(
            Round(
                fault,
                attack,
                recovery_s,
                longest_silence_s(arrivals),
                num_missing(arrivals),
                gateway.log.count("\n") - lines,
                Usage.of(gateway.process.pid),
            )
        )

    def _next_attack(self) -> str:
        """Return a random attack. Each has its turn before one comes again."""
        if not self._attacks:
            self._attacks = sorted(ATTACKS)
            self.random.shuffle(self._attacks)
        return self._attacks.pop()

    @property
    def log_lines_per_minute(self) -> int:
        """The largest number of lines logged in a minute about one source, or about none."""
        return log_lines_per_minute(self.gateway_report.log, self.gateway_report.sources)

    def problems(self) -> list[str]:
        """Return why the run failed, in sentences."""
        found = []
        if any(each.recovery_s is None for each in self.rounds):
            found.append("after some faults, data did not flow again")
        if self.gateway_report.num_missing:
            found.append(f"{self.gateway_report.num_missing} messages of the healthy source are missing")
        if self.gateway_report.exit_status != 0 or self.gateway_report.ended_early:
            found.append(f"the gateway ended with status {self.gateway_report.exit_status}")
        return found


def _line(done: Round) -> str:
    recovered = "did not recover" if done.recovery_s is None else f"data again after {done.recovery_s:.2f} s"
    silence_ms = 1000 * max(done.longest_silence_s.values())
    return (
        f"{done.fault:24} {done.attack:26} {recovered}; healthy: {silence_ms:4.0f} ms silent, "
        f"{done.missing} missing; {done.usage.memory_kib / 1024:.1f} MiB, {done.usage.threads} threads, "
        f"{done.usage.descriptors} descriptors"
    )


def _reload(
    gateway: RunningGateway, sources: Mapping[str, Source], settings: Mapping[str, Any], *, is_odd: bool
) -> None:
    """Let the gateway add or remove a source, and give everything on ROS 2 another name."""
    guest = {"guest": gateway.healthy_port} if is_odd else {}
    ros2 = {**settings["ros2"], "namespace": "guests" if is_odd else "mocap"}
    gateway.write_config({**sources, **guest}, {**settings, "ros2": ros2})
    gateway.process.send_signal(signal.SIGHUP)


@asynccontextmanager
async def _attacking(name: str, target: Target) -> AsyncIterator[None]:
    """Run an attack until the end of the block. Raises RuntimeError if it ends before, by a defect."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.soak.attacks", name, json.dumps(asdict(target))), stdout=DEVNULL
    )
    try:
        yield
        if process.returncode is not None:
            raise RuntimeError(f"the attack {name!r} ended with status {process.returncode}")
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
