"""Terminals: keys without Enter, drawing on the whole screen, and lists that are tables there."""

import asyncio
import codecs
import contextlib
import os
import re
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from enum import Enum
from typing import IO, Any, Final, TypeAlias

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.runtime.safe_text import safe_lines, safe_text

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
    b"\x1b[5~": "page-up",
    b"\x1b[6~": "page-down",
    b"\x1b[H": "home",
    b"\x1b[1~": "home",
    b"\x1b[F": "end",
    b"\x1b[4~": "end",
}
"""What the keys send, some with O in place of [. Any other printable character is its own name."""


def key_names(data: bytes) -> list[str]:
    """Return the names of the keys that sent ``data``; keys without a name are left out."""
    names = []
    for code in _KEY.findall(data):
        text = _NAMES.get(code.replace(b"\x1bO", b"\x1b[")) or code.decode("utf-8", "replace")
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


_ENTER: Final = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
"""The alternate screen, no cursor, and no new line where a line is too long."""
_LEAVE: Final = "\x1b[?7h\x1b[?25h\x1b[0m\x1b[?1049l"

_REDRAW_S: Final = 10.0
"""How often everything is drawn, in case another program has written to the terminal."""

_DEFAULT_SIZE: Final = os.terminal_size((80, 24))
_MAX_SIZE: Final = (1000, 500)
_REPLACEMENTS: Final = {"…": "~", "←": "<", "→": ">", "↑": "^", "↓": "v", "µ": "u", "–": "-", "·": "-"}


class Style(Enum):
    """How a text looks: its codes in an escape sequence (SGR), without and with colours."""

    PLAIN = ("", "")
    STRONG = ("1", "1")
    FAINT = ("2", "2")
    MARKED = ("7", "7")
    GOOD = ("", "32")
    WARNING = ("", "33")
    BAD = ("1", "1;31")


Line: TypeAlias = Sequence[tuple[str, Style]]
"""The parts of a line, without control characters."""


class Screen:
    """The screen of a terminal with this encoding. While it ``is_open``, ``draw`` writes to it."""

    def __init__(self, descriptor: int, encoding: str, environ: Mapping[str, str] = os.environ) -> None:
        self.descriptor = descriptor
        self._encoding = encoding
        self._has_colours = has_colours(environ)
        self._drawn: list[str] = []
        self._drawn_s = 0.0
        self._size = _DEFAULT_SIZE
        self.is_open = False

    @property
    def size(self) -> os.terminal_size:
        """The columns and lines that the terminal has now."""
        try:
            found = os.get_terminal_size(self.descriptor)
        except OSError:
            return self._size
        columns, lines = found.columns or _DEFAULT_SIZE.columns, found.lines or _DEFAULT_SIZE.lines
        return os.terminal_size((min(columns, _MAX_SIZE[0]), min(lines, _MAX_SIZE[1])))

    def open(self) -> None:
        """Switch to a screen of its own, so that the former content comes back at the end."""
        if not self.is_open:
            self.is_open = True
            self._drawn = []
            self._write(_ENTER)

    def close(self) -> None:
        """Switch back."""
        if not self.is_open:
            return
        self.is_open = False
        with contextlib.suppress(OSError, termios.error):  # the terminal is gone
            settings = termios.tcgetattr(self.descriptor)
            flags = settings[0] & ~termios.IXON  # without it, the terminal goes on after Ctrl-S
            termios.tcsetattr(self.descriptor, termios.TCSANOW, [flags, *settings[1:]])
            self._write(_LEAVE)
            termios.tcsetattr(self.descriptor, termios.TCSANOW, settings)

    def redraw(self) -> None:
        """Draw everything at the next call of ``draw``."""
        self._drawn = []

    def draw(self, lines: Sequence[Line]) -> None:
        """Show ``lines`` from the top; write those that differ from what is shown.

        Nothing is written while the terminal does not take it, for example after Ctrl-S.
        """
        if not self.is_open or not select.select([], [self.descriptor], [], 0)[1]:
            return
        size, now_s = self.size, time.monotonic()
        if size != self._size or now_s - self._drawn_s > _REDRAW_S:
            self._size, self._drawn_s, self._drawn = size, now_s, []
        texts = [line_text(line, size.columns, has_colours=self._has_colours) for line in lines[: size.lines]]
        texts += [""] * (size.lines - len(texts))
        parts = [
            f"\x1b[{number};1H\x1b[K{text}"
            for number, text in enumerate(texts, start=1)
            if self._drawn[number - 1 : number] != [text]
        ]
        self._drawn = texts
        self._write("".join(parts))

    def _write(self, text: str) -> None:
        data = encoded(text, self._encoding)
        while data:
            data = data[os.write(self.descriptor, data) :]


def has_colours(environ: Mapping[str, str]) -> bool:
    """Return whether to use colours: https://no-color.org."""
    return not environ.get("NO_COLOR")


def line_text(line: Line, width: int, *, has_colours: bool) -> str:
    """Return a line with escape sequences, cut after ``width`` columns."""
    parts = []
    for text, style in line:
        num_cells = cell_len(text)
        shown = text if num_cells <= width else set_cell_size(text, width)
        width -= min(num_cells, width)
        codes = style.value[has_colours]
        parts.append(f"\x1b[{codes}m{shown}\x1b[0m" if codes and shown else shown)
    return "".join(parts)


def encoded(text: str, encoding: str) -> bytes:
    """Return ``text`` in the encoding of a terminal, with one character in place of each that it lacks."""
    try:
        return text.encode(encoding, _ERRORS)
    except LookupError:
        return text.encode("ascii", _ERRORS)


def _replace(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)  # noqa: S101 - registered for encoding only
    missing = error.object[error.start : error.end]
    return "".join(_REPLACEMENTS.get(character, "?") for character in missing), error.end


_ERRORS: Final = "rtc3d-gateway-terminal"
codecs.register_error(_ERRORS, _replace)


def print_list(
    console: Console,
    headings: Sequence[str],
    records: Sequence[Sequence[str]],
    *,
    numbers: Collection[str] = (),
    title: str = "",
) -> None:
    """Write a table on a terminal, its columns ``numbers`` aligned right; otherwise, a line per record."""
    if not console.is_terminal:
        write_records(console.file, records)
        return
    table = list_table(title)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in numbers else "left", overflow="fold")
    for record in records:
        # Text objects, because rich would read square brackets in a string as markup.
        table.add_row(*(Text(safe_lines(field)) for field in record))
    if records or title:
        console.print(table)


def list_table(title: str = "") -> Table:
    """Return a table without columns and rows, as all lists look on a terminal."""
    return Table(
        title=Text(safe_text(title)) if title else None,
        title_justify="left",
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
    )


def write_records(out: IO[str], records: Sequence[Sequence[str]]) -> None:
    """Write a line for each record. Tabs and line ends in its fields are escaped."""
    for record in records:
        print(*map(safe_text, record), sep="\t", file=out)  # rich would expand the tabs
