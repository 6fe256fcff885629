"""Somebody sets the clock of the gateway's computer while frames arrive."""

import re
import struct
import subprocess
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.support.gateway_process import GatewayProcess, gaps, gateway_process, simulator
from tests.support.needs import need_programs
from tests.support.waiting import wait_until

RATE_HZ: Final = 100

TOLERANCE_S: Final = 1.0
"""How late the frames of a busy machine may be; the steps are of 5 s and more."""

STEP: Final = re.compile(r"(forward|back) by (\d+\.\d{3}) s")
"""What the log says about the clock: the direction and the seconds."""

SHIM: Final = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static volatile long long *offset_ns;

__attribute__((constructor)) static void map_offset(void) {
    int file = open(getenv("CLOCK_OFFSET_FILE"), O_RDONLY);
    offset_ns = mmap(NULL, sizeof *offset_ns, PROT_READ, MAP_SHARED, file, 0);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(clock, time);
    if (result == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        long long now_ns = time->tv_sec * 1000000000LL + time->tv_nsec + *offset_ns;
        time->tv_sec = now_ns / 1000000000;
        time->tv_nsec = now_ns % 1000000000;
    }
    return result;
}
"""
"""Adds the number in a file to the wall clock of one process."""


class WallClock:
    """The wall clock that a process with ``environ`` sees. LD_PRELOAD allows no space in ``folder``."""

    def __init__(self, folder: Path) -> None:
        need_programs("gcc", packages="gcc and libc6-dev")
        source, library, self._file = folder / "shim.c", folder / "shim.so", folder / "offset"
        source.write_text(SHIM)
        subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        self._file.write_bytes(bytes(8))
        self.environ = {"LD_PRELOAD": str(library), "CLOCK_OFFSET_FILE": str(self._file)}

    def set(self, offset_s: float) -> None:
        """Set the clock to the true time plus ``offset_s``."""
        with self._file.open("r+b") as file:  # in place, because the process has mapped the file
            file.write(struct.pack("<q", round(1e9 * offset_s)))


def capture_offsets_s(gateway: GatewayProcess, component: str) -> list[float]:
    """Return how far the capture time of each message is ahead of the server's even time, in s."""
    headers = gateway.headers[component]
    first = headers[0]
    return [
        (header.capture_utime - first.capture_utime) / 1e6
        - (header.frame_number - first.frame_number) / RATE_HZ
        for header in headers
    ]


def test_a_step_changes_time_stamps_and_nothing_else(tmp_path: Path) -> None:
    stream = {"components": ["3d", "6d"], "backlog": "latest", "adapt_rate": True}
    options = ("--rate", str(RATE_HZ), "--analog", "0", "--plates", "0")
    with ExitStack() as stack:
        port, _ = stack.enter_context(simulator(*options))
        runs = []  # at the same time, because each takes ten seconds
        for number, offset_s in enumerate((5.0, -5.0, 200 * 86_400.0)):
            folder = tmp_path / str(number)
            folder.mkdir()
            clock = WallClock(Path(stack.enter_context(TemporaryDirectory())))
            # Frames that are late on a busy machine must not be skipped; a step is larger than this.
            process = gateway_process(folder, port, clock.environ, streams=[stream], max_lag_ms=4000)
            runs.append((stack.enter_context(process), clock, offset_s))
        for gateway, _, _ in runs:
            gateway.wait_for_clock()
        for gateway, clock, offset_s in runs:
            gateway.wait_for_frames(RATE_HZ // 2)
            assert STEP.findall(gateway.log) == []
            clock.set(offset_s)
        num_frames = [len(gateway.headers["3d"]) + 2 * RATE_HZ for gateway, _, _ in runs]
        for (gateway, _, offset_s), count in zip(runs, num_frames, strict=True):
            assert_step_changes_time_stamps_only(gateway, offset_s, count)


def assert_step_changes_time_stamps_only(gateway: GatewayProcess, offset_s: float, num_frames: int) -> None:
    wait_until(lambda: len(gateway.headers["3d"]) >= num_frames)
    wait_until(lambda: STEP.search(gateway.log))
    [stream_status] = gateway.statuses[-1].streams
    assert (stream_status.rate, stream_status.restarts, stream_status.drops) == ("AllFrames", 0, [])
    direction, size = ("forward", offset_s) if offset_s > 0 else ("back", -offset_s)
    [(logged_direction, logged_s)] = STEP.findall(gateway.log)
    assert (logged_direction, logged_s[:-4]) == (direction, f"{size:.1f}"[:-2])
    for component in ("3d", "6d"):
        headers = gateway.headers[component]
        assert gaps([header.sequence for header in headers]) == []
        assert gaps([header.frame_number for header in headers]) == []
        assert all(header.capture_utime <= header.utime for header in headers)
        offsets_s = capture_offsets_s(gateway, component)[RATE_HZ:]
        followed = [abs(each - offset_s) < TOLERANCE_S for each in offsets_s]
        assert followed == sorted(followed), "the capture time follows once, and for good"
        assert followed.count(True) >= 2 * RATE_HZ - 10
        before = [each for each, has_followed in zip(offsets_s, followed, strict=True) if not has_followed]
        assert all(abs(each) < TOLERANCE_S for each in before)
