import os
import pty
import select
from collections.abc import Iterator

import pytest

from gateway.terminal.screen import Screen, Style, encoded, line_text


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    master, end = pty.openpty()
    yield master, end
    os.close(master)
    os.close(end)


def read(master: int) -> str:
    data = b""
    while select.select([master], [], [], 0.05)[0]:
        data += os.read(master, 65536)
    return data.decode()


def test_only_lines_that_change_are_written(terminal: tuple[int, int]) -> None:
    master, end = terminal
    screen = Screen(end, "utf-8", {})
    screen.open()
    screen.draw([[("first", Style.PLAIN)], [("second", Style.PLAIN)]])
    shown = read(master)
    assert "\x1b[?1049h" in shown
    assert "\x1b[1;1H\x1b[Kfirst\x1b[2;1H\x1b[Ksecond" in shown
    screen.draw([[("first", Style.PLAIN)], [("other", Style.PLAIN)]])
    assert read(master) == "\x1b[2;1H\x1b[Kother"
    screen.redraw()
    screen.draw([[("first", Style.PLAIN)], [("other", Style.PLAIN)]])
    assert "first" in read(master)
    screen.close()
    assert read(master).endswith("\x1b[?1049l")
    screen.draw([[("never", Style.PLAIN)]])
    assert read(master) == ""


def test_colours_are_left_out_if_the_user_wants_none(terminal: tuple[int, int]) -> None:
    master, end = terminal
    for environ, expected in (({}, "\x1b[1;31mbad\x1b[0m"), ({"NO_COLOR": "1"}, "\x1b[1mbad\x1b[0m")):
        screen = Screen(end, "utf-8", environ)
        screen.open()
        screen.draw([[("bad", Style.BAD)]])
        assert expected in read(master)


def test_a_line_is_cut_where_the_screen_ends() -> None:
    line = [("漢字", Style.PLAIN), ("abc", Style.GOOD)]
    assert line_text(line, 6, has_colours=True) == "漢字\x1b[32mab\x1b[0m"
    assert line_text(line, 3, has_colours=True) == "漢 "
    assert line_text(line, 0, has_colours=True) == ""


@pytest.mark.parametrize("encoding", ["ascii", "iso8859-1", "no-such-encoding"])
def test_an_encoding_without_a_character_gets_another_one(encoding: str) -> None:
    assert encoded("1–2 → … 漢", encoding) == b"1-2 > ~ ?"
