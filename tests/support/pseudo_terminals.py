"""Programs in front of a terminal, as when a shell starts them."""

import contextlib
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from tests.support.gateway_process import PROGRAM

_TIMEOUT_S: Final = 120.0
_LINE: Final = re.compile(rb"\x1b\[(\d+);1H\x1b\[K((?:(?!\x1b\[\d+;1H|\x1b\[\?).)*)", re.DOTALL)
_STYLE: Final = re.compile(rb"\x1b\[[\d;]*m")


class PseudoTerminal:
    """A terminal with a program in front. ``text`` is what it has shown since the last ``wait_for``."""

    def __init__(self, master: int, process: "subprocess.Popen[bytes]") -> None:
        self._master = master
        self.process = process
        self.text = ""
        self.output = b""
        """Everything that was written."""

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def resize(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def read(self) -> None:
        if select.select([self._master], [], [], 0.1)[0]:
            with contextlib.suppress(OSError):  # EIO: the process has ended
                data = os.read(self._master, 65536)
                self.output += data
                self.text += data.decode("utf-8", "replace")

    def wait_for(self, condition: Callable[[str], Any]) -> None:
        """Wait until ``condition`` holds for what is shown next."""
        deadline_s = time.monotonic() + _TIMEOUT_S
        self.text = ""
        while not condition(self.text):
            assert time.monotonic() < deadline_s, self.text
            self.read()

    def wait_for_screen(self, condition: Callable[[str], Any]) -> str:
        """Wait until ``condition`` holds for the whole screen, and return it."""
        deadline_s = time.monotonic() + _TIMEOUT_S
        while not condition(self.screen):
            assert time.monotonic() < deadline_s, self.screen
            self.read()
        return self.screen

    @property
    def screen(self) -> str:
        """What the screen shows, of a program that draws it line by line; "" while it shows the shell's."""
        _, entered, drawn = self.output.rpartition(b"\x1b[?1049h")
        if not entered or b"\x1b[?1049l" in drawn:
            return ""
        lines: dict[int, str] = {}
        for number, line in _LINE.findall(drawn):
            lines[int(number)] = _STYLE.sub(b"", line).decode("utf-8", "replace")
        return "\n".join(lines.get(number, "") for number in range(1, max(lines, default=0) + 1))

    def wait_for_end(self) -> int:
        deadline_s = time.monotonic() + _TIMEOUT_S
        while self.process.poll() is None:
            assert time.monotonic() < deadline_s
            self.read()
        self.read()
        return self.process.returncode

    def shows_keys(self) -> bool:
        """Whether the terminal waits for Enter and shows what is typed."""
        flags = termios.tcgetattr(self._master)[3]
        return bool(flags & termios.ICANON and flags & termios.ECHO)


@contextlib.contextmanager
def in_terminal(
    *arguments: str, columns: int = 150, lines: int = 40, **environ: str
) -> Iterator[PseudoTerminal]:
    """Run rtc3d-gateway with these arguments in a terminal that controls it."""
    master, end = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", **environ}
    for name in ("COLUMNS", "LINES", "NO_COLOR"):
        if name not in environ:
            environment.pop(name, None)
    with subprocess.Popen(
        ["setsid", "--ctty", *PROGRAM, *arguments], stdin=end, stdout=end, stderr=end, env=environment
    ) as process:
        terminal = PseudoTerminal(master, process)
        terminal.resize(columns, lines)
        try:
            yield terminal
        finally:
            process.kill()
            os.close(master)
            os.close(end)
