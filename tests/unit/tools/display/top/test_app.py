"""The screen of ``top``: its tables, and its keys."""

import pytest
from rich.cells import cell_len

from gateway.tools.display.terminal import Line, Style
from gateway.tools.display.top.app import Display
from gateway.tools.display.top.keys import KEYS
from gateway.tools.display.top.pages import PAGES
from gateway.tools.display.top.table import (
    Order,
    TopColumn,
    TopSection,
    TopTable,
    filtered,
    laid_out,
    number_cell,
    sorted_by,
    text_cell,
    wrapped,
)
from tests.support.statuses import stream
from tests.unit.tools.display.live_lab import Lab

COLUMNS = (TopColumn("marker"), TopColumn("%", is_number=True), TopColumn("unit", rank=1))


def table(*rows: tuple[str, float | None]) -> TopTable:
    cells = [(text_cell(name), number_cell(value, 1), text_cell("mm")) for name, value in rows]
    return TopTable(COLUMNS, [TopSection(cells, [("lab: streaming", Style.GOOD)])], "nothing")


def texts(lines: list[Line]) -> list[str]:
    return ["".join(text for text, _ in line) for line in lines]


def names(found: TopTable) -> list[str]:
    return [row[0].text for section in found.sections for row in section.rows]


def test_numbers_are_on_the_right_and_texts_on_the_left() -> None:
    lines = laid_out(table(("LASI", 9), ("marker 2", 100.25), ("漢字", 1)), 80)
    assert texts([lines.titles]) == ["marker        %  unit"]
    rows = ["LASI        9.0  mm  ", "marker 2  100.2  mm  ", "漢字        1.0  mm  "]
    assert texts(lines.body) == ["lab: streaming", *rows]


def test_columns_of_a_higher_rank_are_left_out_first_and_then_texts_are_cut() -> None:
    shown = table(("a very long label", 9))
    assert texts(laid_out(table(("a very long label " * 9, 9)), 31).body[-1:]) == [
        "a very long label a…  9.0  mm  "
    ]
    rows = {22: "a very long label  9.0", 20: "a very long la…  9.0", 5: "a ver…  9.0"}
    assert {width: texts(laid_out(shown, width).body)[-1] for width in rows} == rows


def test_sorting_by_numbers_and_by_names_with_numbers() -> None:
    shown = table(("marker 10", 5), ("marker 2", 70), ("Marker 1", None))
    assert names(sorted_by(shown, None)) == ["marker 10", "marker 2", "Marker 1"]
    assert names(sorted_by(shown, Order("marker"))) == ["Marker 1", "marker 2", "marker 10"]
    assert names(sorted_by(shown, Order("%"))) == ["marker 10", "marker 2", "Marker 1"]
    assert names(sorted_by(shown, Order("%", is_reversed=True))) == ["marker 2", "marker 10", "Marker 1"]
    assert names(sorted_by(shown, Order("no such column"))) == names(shown)


def test_any_name_can_be_sorted() -> None:
    odd = [(name, 1.0) for name in ("9" * 400, "", "²", "a1b", "1a", "٣")]
    assert len(names(sorted_by(table(*odd, ("a1", 2)), Order("marker")))) == 7


def test_the_filter_finds_cells_and_headings_in_any_case() -> None:
    shown = table(("LASI", 9), ("RASI", 10))
    assert names(filtered(shown, "lasi")) == ["LASI"]
    assert names(filtered(shown, "STREAM")) == ["LASI", "RASI"]
    nothing = laid_out(filtered(shown, "x y"), 80)
    assert texts(nothing.body) == ["nothing here contains 'x y'"]


def test_sentences_are_wrapped() -> None:
    assert wrapped("lab: waiting for the server", 12) == ["lab: waiting", "for the", "server"]
    assert wrapped("abcdefgh", 3) == ["abc", "def", "gh"]
    assert wrapped("漢字漢字", 4) == ["漢字", "漢字"]
    assert wrapped("", 4) == []


def test_odd_numbers_do_not_break_the_table() -> None:
    numbers = (None, float("nan"), 1e15, float("inf"), -2.25)
    assert [number_cell(value, 1).text for value in numbers] == ["", "", "1e+15", "", "-2.2"]


class Shown:
    """The display of a source with 30 markers, of which the second one is missing."""

    def __init__(self, width: int = 100, height: int = 20) -> None:
        self.display = Display("Zenoh", has_keys=True)
        self.width, self.height = width, height
        lab = Lab()
        lab.send_status(stream("3d"))
        lab.send_ones("3d", 0, 30, missing=(1,))
        self.sources = [lab.source]
        self.notices: list[str] = []

    def lines(self) -> list[Line]:
        return self.display.lines(self.sources, self.notices, self.width, self.height)

    def texts(self) -> list[str]:
        return ["".join(text for text, _ in line).rstrip() for line in self.lines()]

    def press(self, *keys: str) -> list[str]:
        self.lines()
        for key in keys:
            self.display.press(key)
        return self.texts()

    def body(self) -> list[str]:
        return [line for line in self.texts()[3:-1] if line]


@pytest.mark.parametrize("size", [(40, 10), (200, 60), (20, 3), (1, 1), (80, 24)])
@pytest.mark.parametrize("number", range(len(PAGES)))
def test_every_page_fills_the_screen_and_no_more(size: tuple[int, int], number: int) -> None:
    shown = Shown(*size)
    shown.notices = ["no gateway found on Zenoh; check that it is running with this prefix"]
    texts = shown.press(str(number + 1))
    assert len(texts) == size[1]
    if size[0] >= 40:
        assert all(cell_len(text) <= size[0] for text in texts)


def test_keys_switch_the_page() -> None:
    shown = Shown()
    assert shown.press("2")[2].startswith("marker")
    assert shown.press("right")[2].startswith("tool")
    assert shown.press("shift-tab", "left")[2].startswith("component")
    assert shown.press("left")[2].startswith("time")
    assert shown.press("tab")[2].startswith("component")
    assert shown.press("9", "0", "x")[2].startswith("component")


def test_80_columns_show_the_names_of_all_pages() -> None:
    tabs = "".join(text for text, _ in Display("zenoh", has_keys=True).lines([], [], 80, 24)[1])
    assert tabs.split() == [word for number, page in enumerate(PAGES, 1) for word in (str(number), page.name)]


def test_keys_scroll_and_stop_at_the_ends() -> None:
    shown = Shown()
    shown.press("2")
    assert shown.body()[0].startswith("marker 2 ")
    assert shown.press("down")[3].startswith("marker 1 ")
    assert shown.press("up", "up")[3].startswith("marker 2 ")
    assert shown.press("page-down")[-1].endswith(" 15–30 of 30")
    assert shown.press("end")[-2].startswith("marker 30 ")
    assert shown.press("down", "page-down")[-2].startswith("marker 30 ")
    assert shown.press("home")[3].startswith("marker 2 ")


def test_keys_sort() -> None:
    shown = Shown()
    shown.press("2")
    assert "visible in 10 s↑" in shown.texts()[2]
    assert "visible in 10 s↓" in shown.press("r")[2]
    assert shown.texts()[3].startswith("marker 1 ")
    while "marker↑" not in shown.press("s")[2]:
        pass
    assert shown.texts()[3].startswith("marker 1 ")
    assert shown.press("r")[3].startswith("marker 30 ")


def test_the_filter_is_typed_and_cleared() -> None:
    shown = Shown()
    shown.press("2", "/", *"MARKER", "space", *"39", "backspace")
    assert shown.texts()[-1] == "filter: MARKER 3"
    assert [line.split()[1] for line in shown.body()] == ["3", "30"]
    assert shown.press("q", "backspace", "enter")[-1].startswith("filter: MARKER 3  Esc clear")
    assert not shown.display.is_over
    shown.press("escape")
    assert len(shown.body()) == 16
    shown.press("/", *"xyz", "ctrl-u", "a", "escape")
    assert len(shown.body()) == 16
    shown.press("/", *"nowhere")
    [nothing] = shown.body()
    assert "'nowhere'" in nothing


HELP = "show what the keys do; any key returns"


def shows_help(texts: list[str]) -> bool:
    return any(HELP in text for text in texts)


@pytest.mark.parametrize("key", ["?", "escape", "q", "2", "/", "down", "enter", "space", "x"])
def test_any_key_returns_from_the_help_to_the_page_before(key: str) -> None:
    """The key does nothing else: the page, its order and its place are as before."""
    shown = Shown()
    before = shown.press("2", "r", "down", "down")
    assert not shows_help(before)
    assert shows_help(shown.press("?"))
    assert shown.press(key)[1:] == before[1:]  # without the clock
    assert not shown.display.is_over


def test_the_help_is_on_the_screen_with_the_pages_and_notices() -> None:
    shown = Shown(80, 24)
    shown.notices = ["lcm: the connection is lost"]
    texts = shown.press("3", "?")
    assert (len(texts), texts[2], texts[3].split()[0]) == (24, "lcm: the connection is lost", "key")
    assert all(any(text.startswith(key.shown) for text in texts) for key in KEYS)
    assert texts[-1] == "any key back to the page"
    assert [text for text, style in shown.lines()[1] if style is Style.MARKED] == [" 3 tools"]


@pytest.mark.parametrize("size", [(40, 10), (200, 60), (20, 3), (5, 2), (1, 1), (80, 24)])
def test_the_help_fills_the_screen_and_no_more(size: tuple[int, int]) -> None:
    shown = Shown(*size)
    shown.notices = ["no gateway found on Zenoh; check that it is running with this prefix"] * 5
    texts = shown.press("?")
    assert len(texts) == size[1]
    if size[0] >= 40:
        assert all(cell_len(text) <= size[0] for text in texts)


def test_in_a_filter_a_question_mark_is_text() -> None:
    shown = Shown()
    assert shown.press("/", "a", "?", "h")[-1] == "filter: a?h"
    assert not shows_help(shown.texts())
    assert shows_help(shown.press("enter", "?"))
    assert shown.press("escape")[-1].startswith("filter: a?h  Esc clear"), "Escape only leaves the help"


def test_q_ends() -> None:
    shown = Shown()
    shown.press("q")
    assert shown.display.is_over


def test_notices_are_shown_above_the_table_and_escaped() -> None:
    shown = Shown()
    shown.notices = ["lcm: the connection is lost\x1b[2J"]
    assert shown.texts()[2] == r"lcm: the connection is lost\x1b[2J"


def test_without_a_keyboard_no_key_is_named() -> None:
    display = Display("LCM", has_keys=False)
    assert "quit" not in "".join(text for line in display.lines([], [], 100, 20) for text, _ in line)
