import os
import pty
import select
from collections.abc import Iterator

import pytest

from gateway.tools.display.terminal import Screen, Style, encoded, key_names, line_text


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (b"q", ["q"]),
        (b"Q1/", ["Q", "1", "/"]),
        (b" \r\n\t\x7f", ["space", "enter", "enter", "tab", "backspace"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1bOB", ["up", "down"]),
        (b"\x1b[5~\x1b[6~\x1b[H\x1b[F\x1b[Z", ["page-up", "page-down", "home", "end", "shift-tab"]),
        (b"\x1b", ["escape"]),
        ("é€😀".encode(), ["é", "€", "😀"]),
    ],
)
def test_names_of_keys(data: bytes, names: list[str]) -> None:
    assert key_names(data) == names


@pytest.mark.parametrize(
    "data", [b"\x1b[200~", b"\x1b[1;5Q", b"\x01\x02\0", b"\xff\x80", b"\xc3", b"\x1b[<0;3;4M"]
)
def test_keys_without_a_name_are_left_out(data: bytes) -> None:
    assert key_names(data) == []


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
