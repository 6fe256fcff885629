"""``rtc3d-gateway view`` as a process of its own."""

import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from tests.support.gateway_process import program

_ADDRESS: Final = re.compile(r"http://[\w.:]+")


class ViewProcess:
    """A running view, its address for browsers, and what it has printed so far."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.output = ""
        assert process.stdout is not None
        while not (found := _ADDRESS.search(self.output)):
            line = process.stdout.readline()
            assert line, f"view ended: {self.output}"
            self.output += line
        self.address = found[0]

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        """Stop it; return its exit status. ``output`` is complete then."""
        self.process.send_signal(number)
        rest, _ = self.process.communicate(timeout=60)
        self.output += rest
        return self.process.returncode


@contextmanager
def view_process(*arguments: str) -> Iterator[ViewProcess]:
    """Run ``view`` with these arguments, on a free port, until the end of the block."""
    options = ("--port", "0", "--no-browser", *arguments)
    with program("view", *options, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        yield ViewProcess(process)
