"""The processes that use liblsl, and the messages between them and the gateway.

liblsl bounds neither the number of its clients nor what it reads from them before a line ends, so anyone on
the network can exhaust the memory and the file descriptors of a process that uses it. Here that is only this
process. It has limits of its own, and the gateway starts another one if it ends.

    python -m gateway.outputs.adapters.lsl.process            with a connected socket as standard input
    python -m gateway.outputs.adapters.lsl.process SECONDS    prints the streams there are, for the doctor

To the process, the gateway sends a header (kind, number of the stream, bytes that follow) and content. The
process sends lines of JSON, see ``LslReport``.
"""

import contextlib
import ctypes
import json
import os
import queue
import resource
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.messages.host_time import clock_difference_us
from gateway.runtime.safe_text import safe_text

HEADER: Final = struct.Struct("<BII")
_COUNT: Final = struct.Struct("<I")


class Kind(IntEnum):
    """The kind of a message to the process."""

    OPEN = 1
    """Open a stream; the content is JSON: its facts, and its tree as [name, text or children]."""
    CLOSE = 2
    """Close a stream; no content."""
    SAMPLES = 3
    """Push samples: their number, their times (float64), their values (float32)."""
    TEXTS = 4
    """Push samples of one text each; the content is JSON: a list of times and one of texts."""


class Message(NamedTuple):
    """A message to the process. Times are on the system's monotonic clock, in s."""

    kind: Kind
    stream: int
    content: bytes = b""

    def encode(self) -> bytes:
        """Return the bytes to send."""
        return HEADER.pack(self.kind, self.stream, len(self.content)) + self.content


REPORT_INTERVAL_S: Final = 1.0
"""The process repeats its report this often, even if nothing has changed, to show that it does not hang."""


class LslReport(NamedTuple):
    """What the process reports. ``wanted`` are the numbers of the streams that somebody receives.

    ``ready`` is the version of liblsl, "" while it is not loaded. ``not_opened`` is a stream that liblsl
    cannot open, and why. ``failure`` says why the process ends.
    """

    ready: str = ""
    wanted: tuple[int, ...] = ()
    not_opened: str = ""
    failure: str = ""

    def encode(self) -> bytes:
        """Return one line of JSON."""
        return json.dumps(self._asdict()).encode() + b"\n"

    @classmethod
    def decode(cls, line: bytes) -> "LslReport":
        """Return the report of one line."""
        fields = json.loads(line)
        return cls(**{**fields, "wanted": tuple(fields["wanted"])})


def samples_content(times_s: Sequence[float], values: npt.NDArray[np.float32]) -> bytes:
    """Return the content of SAMPLES; ``values`` has the shape (samples, channels)."""
    times = np.asarray(times_s, "<f8").tobytes()
    return _COUNT.pack(len(times_s)) + times + values.astype("<f4", copy=False).tobytes()


def decode_samples(content: bytes) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return the times and the values, shape (samples, channels)."""
    (count,) = _COUNT.unpack_from(content)
    times = np.frombuffer(content, "<f8", count, _COUNT.size)
    values = np.frombuffer(content, "<f4", -1, _COUNT.size + times.nbytes)
    return times, values.reshape(count, -1)


def opening_content(facts: Mapping[str, Any], tree: Sequence[Any]) -> bytes:
    """Return the content of OPEN."""
    return f"[{json.dumps(facts)}, [{', '.join(map(_tree_json, tree))}]]".encode()


def _tree_json(element: tuple[str, Any]) -> str:
    # One call of json.dumps for thousands of channels would keep all other threads waiting.
    name, content = element
    if isinstance(content, str):
        return json.dumps(element)
    return f'["{name}", [{", ".join(map(_tree_json, content))}]]'


class MessageReader:
    """Cuts the bytes that the process receives into messages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Message]:
        """Return the messages that are complete with ``data``."""
        self._buffer += data
        start = 0
        while len(self._buffer) - start >= HEADER.size:
            kind, stream, size = HEADER.unpack_from(self._buffer, start)
            end = start + HEADER.size + size
            if end > len(self._buffer):
                break
            yield Message(Kind(kind), stream, bytes(self._buffer[start + HEADER.size : end]))
            start = end
        del self._buffer[:start]


# The process that serves streams --------------------------------------------------------------

MAX_MEMORY_BYTES: Final = 768 * 1024 * 1024
MAX_FILES: Final = 4096
_STACK_BYTES: Final = 1024 * 1024
"""The stack of each thread. liblsl has two threads for each stream and one for each receiver.

Stacks count as memory, so MAX_MEMORY_BYTES also limits the number of threads: to about 700, which the service
(TasksMax) allows besides those of the gateway.
"""

_POLL_S: Final = 0.1
"""How often to ask liblsl whether anybody receives a stream."""

_RETRY_S: Final = 1.0
_READ_BYTES: Final = 1 << 20
_SAME_CLOCK_US: Final = 1000
_PR_SET_PDEATHSIG: Final = 1


class _LslProcess:
    """Opens and closes streams, and pushes samples, as the gateway says."""

    def __init__(self, gateway: socket.socket, pylsl: Any) -> None:
        self._gateway = gateway
        self._pylsl = pylsl
        self._reader = MessageReader()
        self._outlets: dict[int, Any] = {}
        self._failed: dict[int, Any] = {}  # the descriptions of streams that could not be opened
        self._retry_s = 0.0
        self._report = LslReport()
        self._reported_s = 0.0
        self._closed: queue.SimpleQueue[list[Any]] = queue.SimpleQueue()
        # LSL's clock minus the monotonic one. In liblsl for Linux, both are the same clock.
        offset_us = clock_difference_us(
            lambda: round(pylsl.local_clock() * 1e6), lambda: time.monotonic_ns() // 1000
        )
        self._offset_s = 0.0 if abs(offset_us) < _SAME_CLOCK_US else offset_us / 1e6
        threading.Thread(target=self._destroy_closed, daemon=True).start()

    def run(self) -> None:
        """Work until the gateway closes its socket."""
        self._send(LslReport(ready=str(self._pylsl.library_version())))
        next_poll_s = 0.0
        while True:
            if select.select([self._gateway], [], [], _POLL_S)[0]:
                data = self._gateway.recv(_READ_BYTES)
                if not data:
                    return
                for message in self._reader.feed(data):
                    self._handle(message)
            if time.monotonic() >= next_poll_s:
                next_poll_s = time.monotonic() + _POLL_S
                if self._failed:
                    self._open_failed()
                outlets = self._outlets.items()
                self._change(wanted=tuple(number for number, outlet in outlets if outlet.have_consumers()))
                if time.monotonic() - self._reported_s >= REPORT_INTERVAL_S:
                    self._send(self._report)

    def _handle(self, message: Message) -> None:
        number = message.stream
        match message.kind:
            case Kind.OPEN:
                facts, tree = json.loads(message.content)
                self._failed[number] = facts | {"tree": tree}
                self._retry_s = 0.0
                self._open_failed()
            case Kind.CLOSE:
                self._failed.pop(number, None)
                if not self._failed:
                    self._change(not_opened="")
                if number in self._outlets:
                    self._closed.put([self._outlets.pop(number)])
            case Kind.SAMPLES if number in self._outlets:
                times_s, values = decode_samples(message.content)
                self._outlets[number].push_chunk(values, list(times_s + self._offset_s))
            case Kind.TEXTS if number in self._outlets:
                times, texts = json.loads(message.content)
                # One by one, each would wake liblsl's threads.
                self._outlets[number].push_chunk(
                    [[text] for text in texts], [time_s + self._offset_s for time_s in times]
                )

    def _open_failed(self) -> None:
        """Open the streams that are not open yet. What fails is tried again every second."""
        if time.monotonic() < self._retry_s:
            return
        self._retry_s = time.monotonic() + _RETRY_S
        problem, pylsl = "", self._pylsl
        for number, description in list(self._failed.items()):
            try:
                info = pylsl.StreamInfo(
                    *(description["name"], description["type"]),
                    *(description["num_channels"], description["rate_hz"]),
                    pylsl.cf_string if description["is_text"] else pylsl.cf_float32,
                    description["source_id"],
                )
                _append(info.desc(), description["tree"])
                self._outlets[number] = pylsl.StreamOutlet(info, 0, description["buffer_s"])
            except Exception as error:  # noqa: BLE001 - of any kind, from liblsl
                problem = f"{description['name']}: {safe_text(str(error), 200)}"
            else:
                del self._failed[number]
        self._change(not_opened=problem)

    def _change(self, **fields: Any) -> None:
        report = self._report._replace(**fields)
        if report != self._report:
            self._send(report)

    def _send(self, report: LslReport) -> None:
        self._report = report
        self._reported_s = time.monotonic()
        self._gateway.sendall(report.encode())

    def _destroy_closed(self) -> None:
        """Destroy outlets in a thread of its own: liblsl waits for its threads, up to some seconds."""
        while True:
            self._closed.get().clear()


def _append(element: Any, children: Any) -> None:
    for name, content in children:
        if isinstance(content, str):
            element.append_child_value(name, content)
        else:
            _append(element.append_child(name), content)


def _limit(kind: int, most: int) -> None:
    hard = resource.getrlimit(kind)[1]
    limit = most if hard == resource.RLIM_INFINITY else min(most, hard)
    with contextlib.suppress(OSError):  # a sandbox may forbid it
        resource.setrlimit(kind, (limit, limit))


def _serve() -> None:
    """Run until the gateway closes the socket. Only that ends the process, not a signal to the service."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    libc = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):  # only Linux has it
        # The kernel kills this process, even if it hangs, when the thread that started it ends.
        libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
    with contextlib.suppress(AttributeError, OSError):  # only Linux has it, and a sandbox may forbid it
        # liblsl's threads, which inherit this, wake up for each sample. As batch jobs, they let the thread
        # go on that pushes, and so find the samples of a chunk together.
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    _limit(resource.RLIMIT_DATA, MAX_MEMORY_BYTES)
    _limit(resource.RLIMIT_NOFILE, MAX_FILES)
    attributes = ctypes.create_string_buffer(256)  # glibc needs 56
    with contextlib.suppress(AttributeError):  # not every C library can limit the stacks of new threads
        libc.pthread_attr_init(attributes)
        libc.pthread_attr_setstacksize(attributes, ctypes.c_size_t(_STACK_BYTES))
        libc.pthread_setattr_default_np(attributes)
    gateway = socket.socket(fileno=0)
    try:
        import pylsl  # noqa: PLC0415 - it can fail, and the gateway is told why

        _LslProcess(gateway, pylsl).run()
    except Exception as error:  # noqa: BLE001 - the gateway reports it
        text = safe_text(f"{type(error).__name__}: {error}", 300)
        with contextlib.suppress(OSError):
            gateway.sendall(LslReport(failure=text).encode())


def _find(seconds: float) -> None:
    """Print what the streams are that liblsl finds."""
    import pylsl  # noqa: PLC0415 - only here and in ``_serve``

    found = [
        {
            "name": info.name(),
            "type": info.type(),
            "source_id": info.source_id(),
            "computer": info.hostname(),
            "rate_hz": info.nominal_srate(),
            "num_channels": info.channel_count(),
        }
        for info in pylsl.resolve_streams(seconds)
    ]
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _find(float(sys.argv[1]))
    else:
        _serve()
    # liblsl would wait for each of its threads. The connections end with the process.
    os._exit(0)
