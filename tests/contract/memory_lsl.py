"""LSL without a process and without liblsl: the process's code runs in a thread, with streams in memory."""

import contextlib
import math
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

from gateway.outputs.adapters.lsl import supervisor
from gateway.outputs.adapters.lsl.output import LslOutput
from gateway.outputs.adapters.lsl.process import _LslProcess
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.contract import Output
from tests.contract.frame_rigs import SOURCES, FrameRig, Received

_PER_TOOL = 8


class MemoryRig(FrameRig):
    """The output for LSL, for tests of frames and of the state of the output."""

    def __init__(self) -> None:
        self._received: list[Received] = []
        self._num_peers = 0
        self._patch = patch.object(supervisor, "_start_process", self._start)
        self._patch.start()
        self.output = self.create()

    def _start(self, _settings: LslSettings) -> tuple[socket.socket, "_Process"]:
        ours, theirs = socket.socketpair()
        return ours, _Process(theirs, _Pylsl(self._take, lambda: self._num_peers > 0))

    def _take(self, stream: str, values: Sequence[float]) -> None:
        source, _, kind = stream.rpartition("_")
        if kind == "6d" and source in SOURCES:
            xs = [float(x) for x in values[::_PER_TOOL] if not math.isnan(x)]
            self._received += [(source, x) for x in xs] * self._num_peers

    def create(self) -> Output:
        return LslOutput(LslSettings(enabled=True))

    def subscribe(self) -> None:
        self._num_peers += 1

    def unsubscribe(self) -> None:
        self._num_peers = 0

    def stall(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self._patch.stop()


class _Process:
    """The process, as a subprocess.Popen: a thread that ends when the gateway closes its socket."""

    def __init__(self, connection: socket.socket, pylsl: "_Pylsl") -> None:
        self._connection = connection
        self._thread = threading.Thread(target=self._run, args=(pylsl,), daemon=True)
        self._thread.start()

    def _run(self, pylsl: "_Pylsl") -> None:
        process = _MemoryProcess(self._connection, pylsl)
        with self._connection, contextlib.suppress(OSError):
            process.run()
        process._closed.put([])

    def kill(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def wait(self, timeout: float | None = None) -> int:
        self._thread.join(timeout)
        if self._thread.is_alive():
            raise subprocess.TimeoutExpired("lsl", timeout or 0.0)
        return 0


class _MemoryProcess(_LslProcess):
    """Ends the thread that destroys outlets, too."""

    def _destroy_closed(self) -> None:
        while outlets := self._closed.get():
            outlets.clear()


class _Pylsl:
    """What the process uses of pylsl."""

    cf_string, cf_float32 = "string", "float32"
    local_clock = staticmethod(time.monotonic)

    def __init__(self, take: Callable[[str, Sequence[float]], None], has_peers: Callable[[], bool]) -> None:
        self._take = take
        self._has_peers = has_peers

    def library_version(self) -> int:
        return 116

    def StreamInfo(self, name: str, *_: object) -> "_Info":  # noqa: N802 - as in pylsl
        return _Info(name)

    def StreamOutlet(self, info: "_Info", _chunk: int, _buffer_s: int) -> "_Outlet":  # noqa: N802
        return _Outlet(info.name, self._take, self._has_peers)


class _Info:
    """The description of a stream, and each element of it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def desc(self) -> "_Info":
        return self

    def append_child(self, _name: str) -> "_Info":
        return self

    def append_child_value(self, name: str, value: str) -> None:
        assert "\0" not in name + value


class _Outlet:
    def __init__(
        self, name: str, take: Callable[[str, Sequence[float]], None], has_peers: Callable[[], bool]
    ) -> None:
        self._name = name
        self._take = take
        self.have_consumers = has_peers

    def push_chunk(self, values: Any, times: Sequence[float]) -> None:
        # Of texts, the rig looks at none.
        if self.have_consumers() and not isinstance(values, list):
            for sample, _ in zip(values, times, strict=True):
                self._take(self._name, sample)
