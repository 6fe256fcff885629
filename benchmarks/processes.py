"""The processes of a benchmark: workers, the gateway, the relay and the router; their CPU time and memory.

The measured process has the first core to itself; all other processes share the other cores. This is the same
for everything that is compared.
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
NATIVE_RELAYS: Final = {
    "zenoh": ROOT / "build" / "native" / "release" / "zenoh-relay",
    "lcm": ROOT / "build" / "native" / "lcm-relay",
}
"""The bare relays without Python, by output; ``make native-peers`` builds them where it can."""

_CORES: Final = sorted(os.sched_getaffinity(0))
_START_S: Final = 120.0  # catches what hangs; on a busy machine, Zenoh took over 30 s to connect
_END_S: Final = 10.0


@contextlib.contextmanager
def _on_measured_core() -> Iterator[None]:
    """Restrict processes started within the context to the first core; child processes inherit this."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, _CORES[:1])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def leave_measured_core() -> None:
    """Restrict this process, and those it starts from now on, to the cores that are not measured."""
    os.sched_setaffinity(0, _CORES[1:] or _CORES)


def cpu_s(pid: int) -> float:
    """Return the user and system CPU time of all threads of a process, in s (see clock_getcpuclockid)."""
    return time.clock_gettime((~pid << 3) | 2)


def tree_cpu_s(pid: int) -> float:
    """Return the CPU time of a process and of the processes that it has started and that still run, in s."""
    try:
        children = [
            int(each)
            for file in Path(f"/proc/{pid}/task").glob("*/children")
            for each in file.read_text().split()
        ]
        return cpu_s(pid) + sum(tree_cpu_s(child) for child in children)
    except OSError:  # it has just ended
        return 0.0


def memory_bytes(pid: int) -> int:
    """Return the resident memory of a process, with native libraries."""
    return _kib(f"/proc/{pid}/smaps_rollup", "Rss")


def peak_memory_bytes(pid: int) -> int:
    """Return the peak resident memory of a process."""
    return _kib(f"/proc/{pid}/status", "VmHWM")


def _kib(file: str, name: str) -> int:
    found = re.search(rf"^{name}:\s*(\d+) kB$", Path(file).read_text(), re.MULTILINE)
    if found is None:
        raise RuntimeError(f"{file} does not contain {name}")
    return int(found[1]) * 1024


class Worker:
    """A process that runs the generator ``work(*arguments)`` and exchanges requests and replies with it.

    The generator first yields ``started``. Then it receives each request and yields the reply.
    """

    def __init__(self, work: Callable[..., Iterator[Any]], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_work, args=(there, work, *arguments), daemon=True)
        self._process.start()
        there.close()
        self.started = self.reply()
        """The first value that the generator yielded."""

    def ask(self, request: object) -> Any:
        """Return the reply to ``request``; raises RuntimeError with the traceback if the worker failed."""
        self._pipe.send(request)
        return self.reply()

    def send(self, request: object) -> None:
        """Send a request; ``reply`` returns the reply to it later."""
        self._pipe.send(request)

    def reply(self) -> Any:
        """Wait for the next reply and return it; raises RuntimeError if the worker failed."""
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
    except BaseException:  # noqa: BLE001 - passed on to the other process
        pipe.send((True, traceback.format_exc()))
    finally:
        generator.close()


@dataclass
class Program:
    """A context in which a program runs, on the first core if it is ``measured``."""

    command: Sequence[str]
    measured: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] = field(init=False)

    def __enter__(self) -> Self:
        with _on_measured_core() if self.measured else contextlib.nullcontext():
            self.process = subprocess.Popen(  # noqa: S603 - the command is our own
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
        """The process ID."""
        return self.process.pid


PLAIN_PYTHON: Final = {"PYTHONPATH": str(ROOT)}
"""The environment in which a program imports the gateway's sources instead of build/compiled."""


def run_measured(command: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    """Run a program on the first core and return its output; raises RuntimeError with it if it failed."""
    with _on_measured_core():
        done = subprocess.run(  # noqa: S603 - the command is our own
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
    return done.stdout


def gateway(file: Path, settings: dict[str, Any], inside: Sequence[str] = ()) -> Program:
    """Return the gateway as users run it; writes ``settings`` to the configuration ``file``.

    ``inside`` as in ``router``.
    """
    file.write_text(yaml.safe_dump(settings))
    command = [*inside, sys.executable, "-m", "gateway", "run", "--config", str(file), "--log-level", "error"]
    return Program(command, measured=True)


def source(name: str, port: int, streams: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """Return the settings of a source at a local port, whose frames the gateway never skips."""
    return {
        "name": name,
        "host": "127.0.0.1",
        "port": port,
        "streams": streams or [{"components": ["all"], "backlog": "all"}],
        # At full speed, frames queue up and arrive late. The gateway must not request a lower rate because of
        # that, nor reconnect in the pause before the next run.
        "max_lag_ms": 60_000,
        "stall_timeout_s": 3600.0,
        "reconnect": {"first_delay_s": 0.05, "max_delay_s": 0.1},
    }


def relay(plan: dict[str, Any]) -> Program:
    """Return the bare relay; relay.py describes ``plan``."""
    return Program([sys.executable, "-m", "benchmarks.relay", json.dumps(plan)], measured=True)


def native_relay(plan: dict[str, Any]) -> Program:
    """Return the bare relay without Python, to the one output of ``plan`` (see ``relay``)."""
    name, port = plan["name"], str(plan["port"])
    if plan["zenoh"]:
        command = [str(NATIVE_RELAYS["zenoh"]), json.dumps(plan["zenoh"]), port]
        for first, last, component, schema in plan["cuts"]:
            command += [f"mocap/{name}/{component}", schema, str(first), str(last)]
    else:
        command = [str(NATIVE_RELAYS["lcm"]), plan["lcm"], port]
        for first, last, component, _ in plan["cuts"]:
            command += [f"MOCAP_{name}_{component}".upper(), str(first), str(last)]
    return Program(command, measured=True)


def zenoh_session_config(
    mode: str, *, connect: Sequence[str] = (), listen: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the configuration of a Zenoh session that connects only to these endpoints."""
    return {
        "mode": mode,
        "connect": {"endpoints": list(connect)},
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }


def router(file: Path, config: dict[str, Any], inside: Sequence[str] = ()) -> Program:
    """Return a Zenoh router; writes its configuration to ``file``. ``router_kind`` names the program.

    ``inside`` precedes the command, such as a command that enters a network namespace.
    """
    file.write_text(json.dumps(config))
    if ZENOHD.exists():
        return Program([*inside, str(ZENOHD), "--config", str(file)], environment={"RUST_LOG": "error"})
    return Program([*inside, sys.executable, "-m", "benchmarks.python_router", str(file)])


def router_config(listen: Sequence[str], connect: Sequence[str] = ()) -> dict[str, Any]:
    """Return the configuration of a router that finds no others, but connects to these."""
    config = zenoh_session_config("router", listen=listen, connect=connect)
    del config["scouting"]["gossip"]  # routers need it for peers
    return config


def router_kind() -> str:
    """Return the name of the program that ``router`` runs."""
    return (
        "zenohd" if ZENOHD.exists() else "a Python session in mode router (`make zenohd` builds the real one)"
    )


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait until ``condition`` holds; raises TimeoutError with ``what`` after _START_S."""
    deadline_s = time.monotonic() + _START_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"{what}: not within {_START_S:g} s")
        time.sleep(0.05)
