"""The table of the keys of ``top``, and what is made of it: the help, the last line, and the reference."""

import re
from pathlib import Path

import pytest
from rich.cells import cell_len

from gateway.tools.display.terminal import Line, key_names
from gateway.tools.display.top.keys import ACTIONS, CLEAR, KEYS, TopKey, help_page, short_keys

REFERENCE = (Path(__file__).parents[5] / "docs/reference/commands.md").read_text(encoding="utf-8")
SENT = {  # what terminals send for the keys that are no characters
    "left": "\x1b[D",
    "right": "\x1b[C",
    "up": "\x1b[A",
    "down": "\x1b[B",
    "tab": "\t",
    "shift-tab": "\x1b[Z",
    "page-up": "\x1b[5~",
    "page-down": "\x1b[6~",
    "home": "\x1b[H",
    "end": "\x1b[F",
    "space": " ",
    "escape": "\x1b",
}
ARROWS = {"left": "←", "right": "→", "up": "↑", "down": "↓", "escape": "Esc"}


def texts(lines: list[Line]) -> list[str]:
    return ["".join(text for text, _ in line).rstrip() for line in lines]


def test_each_action_is_of_one_key_that_terminals_send() -> None:
    assert sum(len(key.actions) for key in KEYS) == len(ACTIONS)
    assert key_names("".join(SENT.get(name, name) for name in ACTIONS).encode()) == [*ACTIONS]


@pytest.mark.parametrize("key", [key for key in KEYS if key.actions], ids=lambda key: key.shown)
def test_each_key_with_an_action_is_shown(key: TopKey) -> None:
    """All but Q, which does what q does."""
    shown = re.split("[ ,]+", key.shown.replace("Page ", "Page-"))
    if "to" in shown:
        assert [*key.actions] == [str(number) for number in range(int(shown[0]), int(shown[2]) + 1)]
        return
    names = {ARROWS.get(name, name if len(name) == 1 else name.title()) for name in key.actions}
    assert names - {"Q"} == {*shown} - {"Ctrl-C"}


def test_the_reference_has_the_table() -> None:
    rows = [f"| {key.shown} | {key.meaning} |" for key in KEYS]
    expected = "\n".join(["| key | what it does |", "|---|---|", *rows, "", ""])
    part = REFERENCE.partition("\n## rtc3d-gateway top\n")[2].partition("\n## ")[0]
    assert expected in part.replace("`fg`", "fg"), f"put this into the section of top:\n{expected}"


def test_the_help_has_a_line_for_each_key_where_there_is_room() -> None:
    lines = help_page(110)
    [titles] = texts([lines.titles])
    column = titles.index("what it does")
    assert [line[:column].rstrip() for line in texts(lines.body)] == [key.shown for key in KEYS]
    assert [line[column:] for line in texts(lines.body)] == [key.meaning for key in KEYS]


@pytest.mark.parametrize("width", [80, 40])
def test_the_help_is_wrapped(width: int) -> None:
    lines = help_page(width)
    assert max(cell_len(line) for line in texts(lines.body)) <= width
    column = texts([lines.titles])[0].index("what it does")
    words = " ".join(line[column:] for line in texts(lines.body)).split()
    assert words == " ".join(key.meaning for key in KEYS).split()
    assert sum(bool(line[:column].strip()) for line in texts(lines.body)) == len(KEYS)


def test_the_help_fits_into_a_usual_terminal() -> None:
    assert len(help_page(80).body) <= 24 - len(["title", "pages", "notice", "titles", "footer"])


@pytest.mark.parametrize("width", [-1, 0, 1])
def test_no_width_is_too_small(width: int) -> None:
    assert help_page(width).body


def test_the_last_line_names_keys_that_do_something() -> None:
    assert CLEAR in KEYS
    for is_filtered in (False, True):
        line = "".join(text for text, _ in short_keys(is_filtered=is_filtered)).rstrip()
        shown = [" ".join(key.short) for key in KEYS if key.short and (key is not CLEAR or is_filtered)]
        assert sorted(line.split("  ")) == sorted(shown)
        assert ("Esc clear" in line) == is_filtered
