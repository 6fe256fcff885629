import pytest

from gateway.terminal.screen import Line, Style
from gateway.top.table import (
    Column,
    Order,
    Section,
    Table,
    filtered,
    laid_out,
    number_cell,
    sorted_by,
    text_cell,
    wrapped,
)

COLUMNS = (Column("marker"), Column("%", is_number=True), Column("unit", rank=1))


def table(*rows: tuple[str, float | None]) -> Table:
    cells = [(text_cell(name), number_cell(value, 1), text_cell("mm")) for name, value in rows]
    return Table(COLUMNS, [Section(cells, [("lab: streaming", Style.GOOD)])], "nothing")


def texts(lines: list[Line]) -> list[str]:
    return ["".join(text for text, _ in line) for line in lines]


def names(found: Table) -> list[str]:
    return [row[0].text for section in found.sections for row in section.rows]


def test_numbers_are_on_the_right_and_texts_on_the_left() -> None:
    lines = laid_out(table(("LASI", 9), ("marker 2", 100.25)), 80)
    assert texts([lines.titles]) == ["marker        %  unit"]
    assert texts(lines.body) == ["lab: streaming", "LASI        9.0  mm  ", "marker 2  100.2  mm  "]


def test_columns_of_a_higher_rank_are_left_out_first_and_then_texts_are_cut() -> None:
    shown = table(("a very long label", 9))
    assert texts(laid_out(table(("a very long label " * 9, 9)), 31).body[-1:]) == [
        "a very long label a…  9.0  mm  "
    ]
    assert texts(laid_out(shown, 22).body[1:]) == ["a very long label  9.0"]
    assert texts(laid_out(shown, 20).body[1:]) == ["a very long la…  9.0"]
    assert texts(laid_out(shown, 5).body[-1:]) == ["a ver…  9.0"]


def test_sorting_by_numbers_and_by_names_with_numbers() -> None:
    shown = table(("marker 10", 5), ("marker 2", 70), ("Marker 1", None))
    assert names(sorted_by(shown, None)) == ["marker 10", "marker 2", "Marker 1"]
    assert names(sorted_by(shown, Order("marker"))) == ["Marker 1", "marker 2", "marker 10"]
    assert names(sorted_by(shown, Order("%"))) == ["marker 10", "marker 2", "Marker 1"]
    assert names(sorted_by(shown, Order("%", is_reversed=True))) == ["marker 2", "marker 10", "Marker 1"]
    assert names(sorted_by(shown, Order("no such column"))) == names(shown)


@pytest.mark.parametrize("name", ["9" * 400, "", "²", "a1b", "1a", "٣"])
def test_any_name_can_be_sorted(name: str) -> None:
    assert len(names(sorted_by(table((name, 1), ("a1", 2), ("1a", 3)), Order("marker")))) == 3


def test_the_title_of_the_order_is_marked() -> None:
    assert texts([laid_out(table(), 80, Order("%")).titles]) == ["marker  %↑  unit"]
    assert texts([laid_out(table(), 80, Order("%", is_reversed=True)).titles]) == ["marker  %↓  unit"]


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


def test_wide_characters_keep_the_columns() -> None:
    lines = texts(laid_out(table(("漢字", 1), ("LASI", 1)), 80).body[1:])
    assert lines == ["漢字    1.0  mm  ", "LASI    1.0  mm  "]


@pytest.mark.parametrize(
    ("value", "text"), [(None, ""), (float("nan"), ""), (1e15, "1e+15"), (float("inf"), ""), (-2.25, "-2.2")]
)
def test_odd_numbers_do_not_break_the_table(value: float | None, text: str) -> None:
    assert number_cell(value, 1).text == text
