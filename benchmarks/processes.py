"""The processes of a benchmark: workers, the gateway, the relay and the router, and what they use.

What is measured has one processor to itself, everything else the others, the same for all that is compared.
"""

import contextlib
import json
import multiprocessing
import os
import re
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Self

import yaml

ROOT: Final = Path(__file__).parents[1]
ZENOHD: Final = ROOT / "build" / "zenohd" / "bin" / "zenohd"
_CORES: Final = sorted(os.sched_getaffinity(0))
_START_S: Final = 30.0
_END_S: Final = 10.0


@contextlib.contextmanager
def _on_measured_core() -> Iterator[None]:
    """What is started within has the first processor, and no other: it is inherited."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, _CORES[:1])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def leave_measured_core() -> None:
    """Keep this process, and what it starts from now on, off the measured processor."""
    os.sched_setaffinity(0, _CORES[1:] or _CORES)


def cpu_s(pid: int) -> float:
    """Return the CPU time, user and system, that all threads of a process have used (clock_getcpuclockid)."""
    return time.clock_gettime((~pid << 3) | 2)


def memory_bytes(pid: int) -> int:
    """Return what a process has in memory, native libraries' share included."""
    return _kib(f"/proc/{pid}/smaps_rollup", "Rss")


def peak_memory_bytes(pid: int) -> int:
    """Return the most that a process ever had in memory."""
    return _kib(f"/proc/{pid}/status", "VmHWM")


def _kib(file: str, name: str) -> int:
    found = re.search(rf"^{name}:\s*(\d+) kB$", Path(file).read_text(), re.MULTILINE)
    if found is None:
        raise RuntimeError(f"{file} has no {name}")
    return int(found[1]) * 1024


class Worker:
    """A function in a process of its own: ``work(requests, *arguments)`` gives a reply to each request.

    ``work`` is a generator: it is sent each request and yields the reply, the first reply unasked.
    """

    def __init__(self, work: Callable[..., Iterator[Any]], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_work, args=(there, work, *arguments), daemon=True)
        self._process.start()
        there.close()
        self.started = self.reply()
        """The first reply."""

    def ask(self, request: object) -> Any:
        """Return the reply to ``request``; raises RuntimeError with the worker's traceback if it failed."""
        self._pipe.send(request)
        return self.reply()

    def send(self, request: object) -> None:
        """Send a request whose reply is fetched later with ``reply``."""
        self._pipe.send(request)

    def reply(self) -> Any:
        """Wait for the next reply."""
        failed, value = self._pipe.recv()
        if failed:
            raise RuntimeError(value)
        return value

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _work(pipe: Connection, work: Callable[..., Any], *arguments: object) -> None:
    generator = work(*arguments)
    try:
        pipe.send((False, next(generator)))
        while True:
            pipe.send((False, generator.send(pipe.recv())))
    except (EOFError, StopIteration, BrokenPipeError):
        pass
    except BaseException:  # noqa: BLE001 - whatever it was, the asker has to know
        pipe.send((True, traceback.format_exc()))
    finally:
        generator.close()


@dataclass
class Program:
    """A program that runs as long as the context lasts; ``measured``, on the first processor."""

    command: Sequence[str]
    measured: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] = field(init=False)

    def __enter__(self) -> Self:
        with _on_measured_core() if self.measured else contextlib.nullcontext():
            self.process = subprocess.Popen(  # noqa: S603 - programs of ours
                self.command, cwd=ROOT, env=os.environ | dict(self.environment), stdout=subprocess.DEVNULL
            )
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    @property
    def pid(self) -> int:
        """The process's number."""
        return self.process.pid


PLAIN_PYTHON: Final = {"PYTHONPATH": str(ROOT)}
"""The environment of a program that takes the gateway's modules from the sources, not from build/compiled."""


def run_measured(command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    """Run a program on the first processor to its end; raises RuntimeError with what it said if it failed."""
    with _on_measured_core():
        done = subprocess.run(  # noqa: S603 - programs of ours
            command,
            cwd=ROOT,
            env=os.environ | dict(environment or {}),
            check=False,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    if done.returncode:
        raise RuntimeError(done.stdout)


def gateway(file: Path, settings: dict[str, Any]) -> Program:
    """Return the gateway as users run it, with ``settings`` in the configuration ``file``."""
    file.write_text(yaml.safe_dump(settings))
    command = [sys.executable, "-m", "gateway", "run", "--config", str(file), "--log-level", "error"]
    return Program(command, measured=True)


def source(name: str, port: int, streams: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """Return a gateway's source on a port of this machine, every frame of which counts."""
    return {
        "name": name,
        "host": "127.0.0.1",
        "port": port,
        "streams": streams or [{"components": ["all"], "backlog": "all"}],
        # A blast is as late as it is long; nobody is to ask for less, nor to connect anew between two.
        "max_lag_ms": 60_000,
        "stall_timeout_s": 3600.0,
        "reconnect": {"first_delay_s": 0.05, "max_delay_s": 0.1},
    }


def relay(plan: dict[str, Any]) -> Program:
    """Return the bare relay; ``plan`` is its only argument."""
    return Program([sys.executable, "-m", "benchmarks.relay", json.dumps(plan)], measured=True)


def zenoh_keys(mode: str, *, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> dict[str, Any]:
    """Return Zenoh's configuration of a session that meets others at these endpoints only."""
    return {
        "mode": mode,
        "connect": {"endpoints": list(connect)},
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }


def router(endpoint: str) -> contextlib.AbstractContextManager[object]:
    """Return a Zenoh router that listens at ``endpoint`` while the context lasts: see ``router_kind``."""
    if not ZENOHD.exists():
        return Worker(_python_router, endpoint)
    return Program(
        [str(ZENOHD), "--listen", endpoint, "--no-multicast-scouting"], environment={"RUST_LOG": "error"}
    )


def router_kind() -> str:
    """Return which router ``router`` runs, in words."""
    return (
        "zenohd" if ZENOHD.exists() else "a Python session in mode router (`make zenohd` builds the real one)"
    )


def _python_router(endpoint: str) -> Iterator[None]:
    import zenoh  # noqa: PLC0415 - only this process has a session

    keys = zenoh_keys("router", listen=[endpoint])
    keys["scouting"].pop("gossip")
    with zenoh.open(zenoh.Config.from_json5(json.dumps(keys))):
        while True:
            yield None


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Return once ``condition`` holds; raises TimeoutError, naming ``what`` was awaited, after 30 s."""
    deadline_s = time.monotonic() + _START_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"{what}: not within {_START_S:g} s")
        time.sleep(0.05)
