"""A C3D recording as a scene: points, analog channels, force plates and events.

The file is read in a process of its own, with limits on memory and time: ezc3d allocates what a file states,
and malformed files of 0.5 MB made it use 12 GB, crash, or calculate for a minute.
"""

import importlib.util
import logging
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Final

import numpy as np
from typing_extensions import override

from gateway.config.files import check_is_file
from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType, Items
from gateway.runtime.workers import module_environment
from gateway.session.c3d_files.receiving import PARAMETERS_END_BYTES, problem_of_c3d, problem_of_sizes
from gateway.session.server.measurement import ComputedScene, exact_rate, time_us
from gateway.session.server.scene import NO_EVENTS, SampleNumbers
from gateway.simulator.c3d_recording import C3dRecording, load_recording

_SECOND_US: Final = 1_000_000
_log = logging.getLogger(__name__)


class C3dScene(ComputedScene):
    """The scene in a C3D file, which starts again after its last frame.

    Every value is what ezc3d reads, as float32. A marker with any NaN or with a residual of -1 is
    missing, with the bytes of §7.3 and field note 7. Markers and channels have the order of POINT:LABELS
    and ANALOG:LABELS.
    """

    num_frames: int

    def __init__(self, path: Path) -> None:
        """Read the whole file. Raises TakeError if it cannot be played."""
        recording = read_c3d(path)
        self._items = recording.items
        self._events = recording.events
        self.rates_hz = recording.rates_hz
        self.measurement_rate_hz = recording.measurement_rate_hz
        self.num_frames = recording.num_frames
        self.parameters = recording.parameters

    @override
    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        items = self._items[component]
        return items.take(samples, axis=0, mode="wrap")

    @override
    def events(self, start_us: int, stop_us: int) -> Items:
        """Those of the file happen again in each pass."""
        first, stop = self._num_events_before(start_us), self._num_events_before(stop_us)
        if first >= stop:
            return NO_EVENTS
        passes, rows = np.divmod(np.arange(first, stop), len(self._events))
        events: Items = self._events[rows]
        events["timestamp"] += np.array([self._start_us(number) for number in passes.tolist()])
        return events

    def _num_events_before(self, elapsed_us: int) -> int:
        """Return the number of events with time stamps below ``elapsed_us``."""
        rate = exact_rate(self.measurement_rate_hz)
        tick = max(elapsed_us, 0) * rate.numerator // (_SECOND_US * rate.denominator)
        number = tick // self.num_frames
        rest_us = elapsed_us - self._start_us(number)
        return number * len(self._events) + int(np.searchsorted(self._events["timestamp"], rest_us))

    def _start_us(self, number: int) -> int:
        """Return when a pass begins, counted from 0."""
        return time_us(number * self.num_frames, exact_rate(self.measurement_rate_hz))


_MEMORY_BYTES: Final = 512 * 1024**2
"""The address space of the process, 130 MB of which Python and its libraries have."""
_MEMORY_PER_BYTE: Final = 64
"""More address space for each byte of the file; ezc3d needs 15."""
_CPU_S: Final = 20
_CPU_S_PER_MB: Final = 1
"""ezc3d needs 0.05 s."""
_WALL_FACTOR: Final = 3
"""The process may take this many times its CPU time, if the computer is busy or the disk slow."""
_NOTICE_S: Final = 3.0
_NO_MEMORY: Final = 3  # the status of the process
_MAX_WARNINGS: Final = 1000
_REMEDY: Final = "export it again in the software that recorded it, or choose another file"
_INSTALL: Final = "pip install 'rtc3d-gateway[c3d]'"


def read_c3d(path: Path) -> C3dRecording:
    """Return what a C3D file has; log what it lacks. Raises TakeError if it cannot be played."""
    if importlib.util.find_spec("ezc3d") is None:
        raise TakeError(f"{path} cannot be played without ezc3d; install it: {_INSTALL}")
    try:
        check_is_file(path)
        with path.open("rb") as file:
            head = file.read(PARAMETERS_END_BYTES)
            file_bytes = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise TakeError(f"{path} cannot be read: {error.strerror}; give the path of a C3D file") from error
    if problem_of_c3d(head, file_bytes):
        raise TakeError(f"{path} is not a C3D file; choose another file")
    problem = problem_of_sizes(head, file_bytes)
    if problem:
        raise TakeError(f"{path} cannot be read as a C3D file: {problem}; {_REMEDY}")
    result, warnings = _read_in_process(path, file_bytes)
    for warning in warnings:
        _log.warning(warning)
    return result


def _read_in_process(path: Path, file_bytes: int) -> tuple[C3dRecording, list[str]]:
    """Return what the file has, and the warnings about it. Raises TakeError."""
    megabytes = file_bytes / 1e6
    memory_bytes = _MEMORY_BYTES + _MEMORY_PER_BYTE * file_bytes
    cpu_s = _CPU_S + round(_CPU_S_PER_MB * megabytes)
    wall_s = _WALL_FACTOR * cpu_s
    notice = threading.Timer(
        _NOTICE_S,
        lambda: _log.warning(
            "%s (%.1f MB) takes long to read; this ends after %d s at most", path, megabytes, wall_s
        ),
    )
    notice.start()
    try:
        done = subprocess.run(  # noqa: S603 - our own module
            [sys.executable, "-m", "gateway.simulator.c3d_scene", path, str(memory_bytes), str(cpu_s)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**module_environment(), "OPENBLAS_NUM_THREADS": "1"},
            timeout=wall_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise _malformed(path, f"took more than {wall_s} s") from None
    finally:
        notice.cancel()
    if done.returncode == -signal.SIGXCPU:
        raise _malformed(path, f"took more than {cpu_s} s of CPU time")
    if done.returncode == _NO_MEMORY:
        raise TakeError(
            f"{path} cannot be read as a C3D file: it is damaged, or of a kind that ezc3d cannot read with "
            f"{memory_bytes / 1e6:.0f} MB of memory; {_REMEDY}"
        )
    if done.returncode < 0:
        raise _malformed(path, f"crashed ({signal.Signals(-done.returncode).name})")
    if done.returncode:
        raise _malformed(path, f"failed with status {done.returncode}")
    result, warnings = pickle.loads(done.stdout)  # noqa: S301 - from our own process
    if isinstance(result, TakeError):
        raise result
    return result, warnings


def _malformed(path: Path, what: str) -> TakeError:
    return TakeError(f"{path} cannot be read as a C3D file: reading it {what}; {_REMEDY}")


def _main() -> None:
    """Read a file; write a pickled C3dRecording or TakeError, and the warnings, to stdout."""
    path, memory_bytes, cpu_s = sys.argv[1:]
    warnings = BufferingHandler(_MAX_WARNINGS)
    logging.getLogger().addHandler(warnings)
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as out:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # ezc3d prints what it finds unusual
        limits = {"AS": int(memory_bytes), "CPU": int(cpu_s), "CORE": 0}
        for name, value in limits.items():
            kind = getattr(resource, f"RLIMIT_{name}")
            _, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
        try:
            result: C3dRecording | TakeError = load_recording(Path(path))
        except TakeError as error:
            result = error
        except MemoryError:
            sys.exit(_NO_MEMORY)
        pickle.dump((result, [record.getMessage() for record in warnings.buffer]), out)


if __name__ == "__main__":
    _main()
