"""Single keys from the terminal, without Enter, and terminal settings that are restored in any case."""

import asyncio
import contextlib
import os
import signal
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

_READ_BYTES: Final = 256

KEYS: Final = {b" ": "space", b"q": "q", b"Q": "q", b"\x1b[C": "right", b"\x1b[D": "left"}
"""What the keys send, and their names."""


@contextlib.contextmanager
def keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[bool]:
    """Call the action of each key that is pressed, in the running event loop, until the end of the block.

    Yields whether there is a terminal. Nothing is read while the program is in the background: the system
    would stop it. While it is stopped (Ctrl-Z), the terminal has its own settings.
    """
    keyboard = _Keyboard.of_stdin(actions)
    if keyboard is None:
        yield False
        return
    loop = asyncio.get_running_loop()
    keyboard.take()
    loop.add_signal_handler(signal.SIGTSTP, keyboard.suspend)
    loop.add_signal_handler(signal.SIGCONT, keyboard.take)
    try:
        yield True
    finally:
        loop.remove_signal_handler(signal.SIGTSTP)
        loop.remove_signal_handler(signal.SIGCONT)
        keyboard.give_back()


class _Keyboard:
    """The terminal of stdin."""

    def __init__(
        self, descriptor: int, settings: list[Any], actions: Mapping[str, Callable[[], None]]
    ) -> None:
        self._descriptor = descriptor
        self._settings = settings  # those to restore
        self._actions = actions
        self._is_taken = False

    @classmethod
    def of_stdin(cls, actions: Mapping[str, Callable[[], None]]) -> "_Keyboard | None":
        """Return the terminal of stdin; None if it is none."""
        try:
            descriptor = sys.stdin.fileno()
            return cls(descriptor, termios.tcgetattr(descriptor), actions)
        except (AttributeError, OSError, ValueError, termios.error):  # closed, a file, or a pipe
            return None

    def take(self) -> None:
        """Have the terminal deliver each key at once, without showing it, if the program is in front."""
        if self._is_taken or not self._is_in_front():
            return
        self._is_taken = True
        tty.setcbreak(self._descriptor, termios.TCSANOW)
        asyncio.get_running_loop().add_reader(self._descriptor, self._read)

    def give_back(self) -> None:
        """Restore the settings of the terminal."""
        if not self._is_taken:
            return
        self._is_taken = False
        asyncio.get_running_loop().remove_reader(self._descriptor)
        if self._is_in_front():  # otherwise, the shell has its own settings there
            with contextlib.suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._settings)

    def suspend(self) -> None:
        """Stop the program, as Ctrl-Z does, with the terminal's own settings."""
        self.give_back()
        os.kill(os.getpid(), signal.SIGSTOP)

    def _is_in_front(self) -> bool:
        try:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
        except OSError:  # the terminal is gone
            return False

    def _read(self) -> None:
        try:
            pressed = os.read(self._descriptor, _READ_BYTES)
        except OSError:
            pressed = b""
        if not pressed:  # the terminal is gone
            self.give_back()
            return
        while pressed:
            code = next((code for code in KEYS if pressed.startswith(code)), pressed[:1])
            action = self._actions.get(KEYS.get(code, ""))
            if action is not None:
                action()
            pressed = pressed[len(code) :]
