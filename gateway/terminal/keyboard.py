"""Single keys from the terminal, without Enter, and terminal settings that are restored in any case."""

import asyncio
import contextlib
import os
import re
import select
import signal
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

_READ_BYTES: Final = 256
_SEQUENCE_S: Final = 0.05
"""How long the rest of what one key sends may take to arrive."""

_KEY: Final = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*[@-~]|O[A-Za-z])|[\xc2-\xf4][\x80-\xbf]+|[\0-\xff]")
"""What one key sends: an escape sequence, a character in UTF-8, or a byte."""

_INCOMPLETE: Final = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*|O)?$|[\xc2-\xf4][\x80-\xbf]*$")

_NAMES: Final = {
    b" ": "space",
    b"\r": "enter",
    b"\n": "enter",
    b"\t": "tab",
    b"\x1b[Z": "shift-tab",
    b"\x1b": "escape",
    b"\x7f": "backspace",
    b"\b": "backspace",
    b"\x0c": "ctrl-l",
    b"\x15": "ctrl-u",
    b"\x1b[A": "up",
    b"\x1b[B": "down",
    b"\x1b[C": "right",
    b"\x1b[D": "left",
    b"\x1bOA": "up",
    b"\x1bOB": "down",
    b"\x1bOC": "right",
    b"\x1bOD": "left",
    b"\x1b[5~": "page-up",
    b"\x1b[6~": "page-down",
    b"\x1b[H": "home",
    b"\x1b[1~": "home",
    b"\x1bOH": "home",
    b"\x1b[F": "end",
    b"\x1b[4~": "end",
    b"\x1bOF": "end",
}
"""What the keys send, and their names. Any other printable character is its own name."""


def key_names(data: bytes) -> list[str]:
    """Return the names of the keys that sent ``data``; keys without a name are left out."""
    names = []
    for code in _KEY.findall(data):
        text = _NAMES.get(code) or code.decode("utf-8", "replace")
        if text.isprintable() and text != "\N{REPLACEMENT CHARACTER}":
            names.append(text)
    return names


@contextlib.contextmanager
def keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[bool]:
    """Call the action of each key that is pressed, in the running event loop, until the end of the block.

    Yields whether there is a terminal. Nothing is read while the program is in the background: the system
    would stop it. While it is stopped (Ctrl-Z), the terminal has its own settings.
    """
    keyboard = Keyboard.of_stdin()
    if keyboard is None:
        yield False
        return
    loop = asyncio.get_running_loop()

    def read() -> None:
        names = keyboard.read()
        if names is None:
            loop.remove_reader(keyboard.descriptor)
        for name in names or ():
            action = actions.get(name.lower())
            if action is not None:
                action()

    def take() -> None:
        if keyboard.take():
            loop.add_reader(keyboard.descriptor, read)

    def suspend() -> None:
        loop.remove_reader(keyboard.descriptor)
        keyboard.give_back()
        os.kill(os.getpid(), signal.SIGSTOP)

    take()
    loop.add_signal_handler(signal.SIGTSTP, suspend)
    loop.add_signal_handler(signal.SIGCONT, take)
    try:
        yield True
    finally:
        loop.remove_signal_handler(signal.SIGTSTP)
        loop.remove_signal_handler(signal.SIGCONT)
        loop.remove_reader(keyboard.descriptor)
        keyboard.give_back()


class Keyboard:
    """The keys of a terminal. ``settings`` are those to restore."""

    def __init__(self, descriptor: int, settings: list[Any]) -> None:
        self.descriptor = descriptor
        self._settings = settings
        self.is_taken = False
        """Whether the terminal delivers each key at once."""

    @classmethod
    def of_stdin(cls) -> "Keyboard | None":
        """Return the terminal of stdin; None if it is none."""
        try:
            descriptor = sys.stdin.fileno()
            return cls(descriptor, termios.tcgetattr(descriptor))
        except (AttributeError, OSError, ValueError, termios.error):  # closed, a file, or a pipe
            return None

    def take(self) -> bool:
        """Have the terminal deliver each key at once, without showing it, if the program is in front.

        Return whether this changed anything.
        """
        if self.is_taken or not is_in_front(self.descriptor):
            return False
        tty.setcbreak(self.descriptor, termios.TCSANOW)
        self.is_taken = True
        return True

    def give_back(self) -> None:
        """Restore the settings of the terminal."""
        if not self.is_taken:
            return
        self.is_taken = False
        if is_in_front(self.descriptor):  # otherwise, the shell has its own settings there
            with contextlib.suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self.descriptor, termios.TCSADRAIN, self._settings)

    def read(self) -> list[str] | None:
        """Return the names of the keys that were pressed; None, and give it back, if the terminal is gone."""
        try:
            data = os.read(self.descriptor, _READ_BYTES)
            while _INCOMPLETE.search(data) and select.select([self.descriptor], [], [], _SEQUENCE_S)[0]:
                more = os.read(self.descriptor, _READ_BYTES)
                if not more:
                    break
                data += more
        except OSError:
            data = b""
        if not data:
            self.give_back()
            return None
        return key_names(data)


def is_in_front(descriptor: int) -> bool:
    """Return whether the program may read from and write to its terminal, as a shell's foreground job."""
    try:
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:  # the terminal is gone
        return False
