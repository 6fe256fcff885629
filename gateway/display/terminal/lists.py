"""Lists: a table on a terminal; otherwise a line for each record, with tabs between its fields."""

from collections.abc import Collection, Sequence
from typing import IO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.logs.safe_text import safe_lines, safe_text


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
