"""Tables of texts: sorted, filtered, and laid out for a certain width."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from rich.cells import cell_len, chop_cells, set_cell_size

from gateway.runtime.safe_text import quoted
from gateway.tools.display.terminal import Line, Style

_GAP: Final = 2
_LONG_TEXT: Final = 20
_MIN_TEXT: Final = 6
_DIGITS: Final = re.compile(r"(\d+)")
_INDENT: Final = "  "


class TopColumn(NamedTuple):
    """A column, at least ``width`` wide, so that the others stay in place while its numbers change.

    Those with the highest ``rank`` are left out first where the screen is too narrow.
    """

    title: str
    is_number: bool = False
    rank: int = 0
    width: int = 0


class Cell(NamedTuple):
    """A text in a table. ``value`` is what is sorted by; None: nothing is known, which comes last."""

    text: str
    style: Style = Style.PLAIN
    value: float | str | None = None


Row = tuple[Cell, ...]


class TopSection(NamedTuple):
    """Rows below a ``heading``, if it has one; ``notes`` are sentences after the rows."""

    rows: Sequence[Row]
    heading: Sequence[tuple[str, Style]] = ()
    notes: Sequence[tuple[str, Style]] = ()


class TopTable(NamedTuple):
    """What a page shows. ``nothing`` is said instead if it has no rows. ``order`` is the usual one."""

    columns: tuple[TopColumn, ...]
    sections: Sequence[TopSection]
    nothing: str
    order: "Order | None" = None


@dataclass(frozen=True)
class Order:
    """The title of the column that is sorted by, and whether its largest values come first."""

    title: str
    is_reversed: bool = False


class LaidOut(NamedTuple):
    """The lines of a table: its titles, and everything below them."""

    titles: Line
    body: list[Line]


def text_cell(text: str, style: Style = Style.PLAIN) -> Cell:
    """Return a cell that is sorted by its text, if any."""
    return Cell(text, style, text or None)


def number_cell(value: float | None, digits: int = 0, style: Style = Style.PLAIN) -> Cell:
    """Return a cell with a number, empty for None, NaN and infinity; 1e12 and more is as in 1.2e+15."""
    if value is None or not math.isfinite(value):
        return Cell("")
    text = f"{value:.{digits}f}" if -1e12 < value < 1e12 else f"{value:.2g}"
    return Cell(text, style, value)


def filtered(table: TopTable, wanted: str) -> TopTable:
    """Return the rows with this text, in any case, in a cell; and all of a section with it in its heading."""
    if not wanted:
        return table
    text = wanted.casefold()
    sections = []
    for section in table.sections:
        if any(text in heading.casefold() for heading, _ in section.heading):
            sections.append(section)
            continue
        rows = [row for row in section.rows if any(text in cell.text.casefold() for cell in row)]
        notes = [note for note in section.notes if text in note[0].casefold()]
        if rows or notes:
            sections.append(TopSection(rows, section.heading, notes))
    return table._replace(sections=sections, nothing=f"nothing here contains {quoted(wanted)}")


def sorted_by(table: TopTable, order: Order | None) -> TopTable:
    """Return the table with the rows of each section sorted; None means as they are."""
    titles = [column.title for column in table.columns]
    if order is None or order.title not in titles:
        return table
    index = titles.index(order.title)
    sections = []
    for section in table.sections:
        known = [row for row in section.rows if row[index].value is not None]
        unknown = [row for row in section.rows if row[index].value is None]
        known.sort(key=lambda row: _sort_key(row[index].value), reverse=order.is_reversed)
        sections.append(section._replace(rows=known + unknown))
    return table._replace(sections=sections)


def _sort_key(value: float | str | None) -> tuple[float | str, ...]:
    if not isinstance(value, str):
        return (value or 0,)
    # "marker 2" comes before "marker 10". Texts and numbers alternate, so they are never compared.
    parts: list[float | str] = [*_DIGITS.split(value.casefold())]
    parts[1::2] = [float(digits) for digits in parts[1::2]]
    return tuple(parts)


def laid_out(table: TopTable, width: int, order: Order | None = None) -> LaidOut:
    """Return the lines of a table in ``width`` columns; ``order`` is marked at its title."""
    titles = [column.title for column in table.columns]
    if order is not None and order.title in titles:
        titles[titles.index(order.title)] += "↓" if order.is_reversed else "↑"
    widths = [max(cell_len(title), column.width) for title, column in zip(titles, table.columns, strict=True)]
    for section in table.sections:
        for row in section.rows:
            widths = [max(each, _num_cells(cell.text)) for each, cell in zip(widths, row, strict=True)]
    _fit(table.columns, widths, width)
    body: list[Line] = []
    for section in table.sections:
        if body and section.heading:
            body.append([])
        for text, style in section.heading:
            body += [[(line, style)] for line in wrapped(text, width)]
        body += [_row_line(row, table.columns, widths) for row in section.rows]
        for text, style in section.notes:
            body += [[(_INDENT + line, style)] for line in wrapped(text, width - len(_INDENT))]
    if not body:
        body = [[(line, Style.FAINT)] for line in wrapped(table.nothing, width)]
    header = _row_line([Cell(title, Style.STRONG) for title in titles], table.columns, widths)
    return LaidOut(header, body)


def wrapped(text: str, width: int) -> list[str]:
    """Return the lines of a text, broken at spaces where possible."""
    width = max(width, 1)
    lines, line = [], ""
    for word in text.split(" "):
        joined = f"{line} {word}" if line else word
        if cell_len(joined) <= width:
            line = joined
            continue
        if line:
            lines.append(line)
        *full, line = chop_cells(word, width) or [""]
        lines += full
    return [*lines, line] if line else lines


def _fit(columns: Sequence[TopColumn], widths: list[int], width: int) -> None:
    """Make the columns fit: cut long texts, leave out columns (0), and at last cut short texts, too."""
    for rank in sorted({column.rank for column in columns}, reverse=True):
        if _fits(columns, widths, width, _LONG_TEXT):
            break
        for number, column in enumerate(columns):
            if column.rank == rank > 0:
                widths[number] = 0
    least = _LONG_TEXT if _fits(columns, widths, width, _LONG_TEXT) else _MIN_TEXT
    texts = [number for number, column in enumerate(columns) if not column.is_number]
    while _total(widths) > width:
        widest = max(texts, key=lambda number: widths[number])
        if widths[widest] <= least:
            break
        widths[widest] -= 1


def _fits(columns: Sequence[TopColumn], widths: Sequence[int], width: int, least: int) -> bool:
    """Return whether the columns fit if texts are cut, but not to fewer than ``least`` characters."""
    pairs = zip(columns, widths, strict=True)
    return _total([each if column.is_number else min(each, least) for column, each in pairs]) <= width


def _total(widths: Sequence[int]) -> int:
    return sum(each + _GAP for each in widths if each) - _GAP


def _row_line(row: Sequence[Cell], columns: Sequence[TopColumn], widths: Sequence[int]) -> Line:
    parts: list[tuple[str, Style]] = []
    for cell, column, width in zip(row, columns, widths, strict=True):
        if not width:
            continue
        if parts:
            parts.append((" " * _GAP, Style.PLAIN))
        spaces = width - _num_cells(cell.text)
        text = cell.text if spaces >= 0 else set_cell_size(cell.text, width - 1) + "…"
        padding = " " * max(spaces, 0)
        parts.append((padding + text if column.is_number else text + padding, cell.style))
    return parts


def _num_cells(text: str) -> int:
    return len(text) if text.isascii() else cell_len(text)  # as cell_len, but faster
