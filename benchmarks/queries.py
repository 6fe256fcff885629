"""Cached answers while the stream runs: how long they take, and whether the stream notices.

Run from the project's folder: python -m benchmarks.queries [--seconds 10] [--rate-hz 1000] [--queries-hz 200]
Four processes on loopback: the simulator, the gateway, a Zenoh subscriber that counts 3D frames, and
a Zenoh client that asks for parameters from the cache. Exit status 1 if a frame is lost or the median
is not below GOAL_MS.
"""

import argparse
import asyncio
import multiprocessing
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import rtc3d
from rich.console import Console
from rich.table import Table

from gateway.listening import ZenohListener, open_zenoh
from gateway.simulator.server import Simulator
from gateway.simulator.synthetic import SyntheticScene

GOAL_MS: Final = 2.0
KEY: Final = "mocap/lab/parameters"
_SETTLE_S: Final = 3.0
_READY_S: Final = 30.0


def simulate(pipe: Connection, rate_hz: float) -> None:
    """Be the server: tell the port, measure from one word of the pipe to the next, tell what was sent."""

    async def run() -> None:
        scene = SyntheticScene(
            markers=24, tools=4, analog=16, plates=2, rate_hz=rate_hz, analog_rate_hz=rate_hz
        )
        async with Simulator(scene) as simulator:
            simulator.stop_measurement()
            pipe.send(simulator.port)
            await asyncio.to_thread(pipe.recv)
            simulator.start_measurement()
            await asyncio.to_thread(pipe.recv)
            simulator.stop_measurement()
            pipe.send(simulator.sent["3d"])
            await asyncio.to_thread(pipe.recv)

    asyncio.run(run())


def subscribe(pipe: Connection, endpoint: str) -> None:
    """Count 3D frames until as many came as the pipe says were sent, or no more do; tell it, and the gaps."""
    sequences: list[int] = []

    def receive(_key: str, message: bytes) -> None:
        sequences.append(rtc3d.markers_t.decode(message).sequence)

    session = open_zenoh(endpoint)
    ZenohListener(session, "mocap/lab/3d", receive)
    pipe.send("ready")
    sent = pipe.recv()
    deadline_s = time.monotonic() + _SETTLE_S
    while len(sequences) < sent and time.monotonic() < deadline_s:
        time.sleep(0.05)
    gaps = sum(after != before + 1 for before, after in pairwise(sequences))
    pipe.send((len(sequences), gaps))
    session.close()


def query(pipe: Connection, endpoint: str, seconds: float, queries_hz: float) -> None:
    """Ask at a steady pace, whether answers have come or not; tell how long each took, in ms."""
    session = open_zenoh(endpoint)
    took_ms: list[float] = []
    came = threading.Semaphore(0)

    def ask() -> None:
        asked_s = time.perf_counter()

        def take(reply: Any) -> None:
            if reply.ok is not None:
                took_ms.append(1000 * (time.perf_counter() - asked_s))
            came.release()

        session.get(KEY, take, timeout=5)

    pipe.send("ready")
    pipe.recv()
    start_s = time.perf_counter()
    count = round(seconds * queries_hz)
    for number in range(count):
        time.sleep(max(0.0, start_s + number / queries_hz - time.perf_counter()))
        ask()
    for _ in range(count):
        came.acquire(timeout=_SETTLE_S)
    pipe.send(took_ms)
    session.close()


def measure(seconds: float, rate_hz: float, queries_hz: float) -> bool:
    """Run all processes and print the table; return whether the goals were reached."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    with tempfile.TemporaryDirectory() as folder:
        simulator = _started(simulate, rate_hz)
        gateway = _gateway(Path(folder), simulator.recv(), endpoint)
        try:
            _wait_for_parameters(endpoint)
            subscriber = _started(subscribe, endpoint)
            asker = _started(query, endpoint, seconds, queries_hz)
            for peer in (subscriber, asker):
                peer.recv()
            time.sleep(0.5)  # the subscription has reached the gateway
            simulator.send("start")
            asker.send("start")
            took_ms = asker.recv()
            simulator.send("stop")
            sent = simulator.recv()
            subscriber.send(sent)
            received, gaps = subscriber.recv()
            simulator.send("end")
        finally:
            gateway.terminate()
            gateway.wait(10)
    return _report(seconds, sent, received, gaps, round(seconds * queries_hz), took_ms)


def _report(seconds: float, sent: int, received: int, gaps: int, asked: int, took_ms: list[float]) -> bool:
    median_ms = statistics.median(took_ms)
    rows = {
        "frames sent": f"{sent} in {seconds:g} s",
        "frames received": str(received),
        "frames lost": str(sent - received),
        "gaps in sequence": str(gaps),
        "queries": str(asked),
        "cached answers": str(len(took_ms)),
        "median": f"{median_ms:.3f} ms",
        "p99": f"{statistics.quantiles(took_ms, n=100)[98]:.3f} ms",
        "longest": f"{max(took_ms):.3f} ms",
    }
    table = Table(title="Cached answers beside a stream", show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    Console().print(table)
    return sent == received and gaps == 0 and len(took_ms) == asked and median_ms < GOAL_MS


def _started(work: Callable[..., None], *arguments: object) -> Connection:
    """Run ``work`` in a process of its own, which ends with this one; return this end of its pipe."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    context.Process(target=work, args=(there, *arguments), daemon=True).start()
    return here


def _gateway(folder: Path, server_port: int, endpoint: str) -> subprocess.Popen[bytes]:
    config = folder / "gateway.yaml"
    config.write_text(
        f"""
        sources: [{{name: lab, host: 127.0.0.1, port: {server_port}}}]
        zenoh:
          config: {{listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}
        lcm: {{enabled: false}}
        metrics: {{enabled: false}}
        """
    )
    return subprocess.Popen(  # noqa: S603 - this program's own gateway
        [sys.executable, "-m", "gateway", "run", "--config", str(config), "--log-level", "warning"]
    )


def _wait_for_parameters(endpoint: str) -> None:
    deadline_s = time.monotonic() + _READY_S
    while time.monotonic() < deadline_s:
        try:
            session = open_zenoh(endpoint)
        except Exception:  # noqa: BLE001 - the gateway does not listen yet
            time.sleep(0.1)
            continue
        with session:
            if any(reply.ok is not None for reply in session.get(KEY, timeout=2)):
                return
        time.sleep(0.1)
    raise SystemExit(f"the gateway gave no parameters within {_READY_S:g} s")


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def main() -> int:
    """Measure as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--queries-hz", type=float, default=200.0)
    options = parser.parse_args()
    return 0 if measure(options.seconds, options.rate_hz, options.queries_hz) else 1


if __name__ == "__main__":
    sys.exit(main())
