"""Drawing on the whole screen of a terminal, line by line."""

import codecs
import contextlib
import os
import select
import termios
import time
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final, TypeAlias

from rich.cells import cell_len, set_cell_size

_ENTER: Final = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
"""The alternate screen, no cursor, and no new line where a line is too long."""
_LEAVE: Final = "\x1b[?7h\x1b[?25h\x1b[0m\x1b[?1049l"

_REDRAW_S: Final = 10.0
"""How often everything is drawn, in case another program has written to the terminal."""

_DEFAULT_SIZE: Final = os.terminal_size((80, 24))
_MAX_SIZE: Final = (1000, 500)
_REPLACEMENTS: Final = {"…": "~", "→": ">", "↑": "^", "↓": "v", "µ": "u", "–": "-", "·": "-"}


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
        if self.is_open:
            self.is_open = False
            with contextlib.suppress(OSError, termios.error):  # the terminal is gone
                self._write_anyway(_LEAVE)

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

    def _write_anyway(self, text: str) -> None:
        """Write, also after Ctrl-S: without IXON, the terminal goes on."""
        settings = termios.tcgetattr(self.descriptor)
        flags = settings[0]
        termios.tcsetattr(self.descriptor, termios.TCSANOW, [flags & ~termios.IXON, *settings[1:]])
        self._write(text)
        termios.tcsetattr(self.descriptor, termios.TCSANOW, [flags, *settings[1:]])

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
