"""``echo --last`` as a program: what was before it began, and what it missed, is printed in order."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.messages.decode import prefix_of
from tests.support.errors import names
from tests.support.gateway_process import PROGRAM
from tests.support.record_process import MARKERS, lab, wait_for_frames
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns


@contextmanager
def echo(folder: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``echo --json`` into the file ``out`` until the end of the block, with its messages beside it."""
    with (
        (folder / "out").open("wb") as out,
        (folder / "err").open("wb") as err,
        subprocess.Popen([*PROGRAM, "echo", "--json", *options], stdout=out, stderr=err) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def sequences(path: Path) -> list[int]:
    """Return the numbers of the complete lines so far."""
    text = path.read_text() if path.exists() else ""
    return [json.loads(line)["sequence"] for line in text.splitlines(keepends=True) if line.endswith("\n")]


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_what_was_before_and_during_a_stop_is_printed_in_order(tmp_path: Path, side: str) -> None:
    """The last seconds come first; a stopped subscriber loses messages, which the history has."""
    with lab(tmp_path, side) as gateway:
        wait_for_frames(gateway, 50)
        options = [*gateway.options]
        if side == "lcm":
            options[-1] += "&recv_buf_size=60000"
        with echo(tmp_path, *options, "--component", "3d", "--last", "60") as process:
            wait_until(lambda: len(sequences(tmp_path / "out")) > 50)
            os.kill(process.pid, signal.SIGSTOP)
            wait_for_frames(gateway, 100)
            os.kill(process.pid, signal.SIGCONT)
            newest = prefix_of(gateway.published[MARKERS][-1]).sequence
            wait_until(lambda: sequences(tmp_path / "out")[-1] > newest)
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
    printed = sequences(tmp_path / "out")
    assert printed == [*range(len(printed))]
    report = (tmp_path / "err").read_text()
    assert int(report.split()[0]) > 50  # messages from the history
    assert names(report, "no gaps")
