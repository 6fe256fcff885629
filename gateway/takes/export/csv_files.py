"""Export to CSV (RFC 4180): a file for each component."""

import csv
import io
from collections.abc import Iterable, Iterator
from typing import IO, Any

import numpy as np

from gateway.messages.descriptions.labels import distinct
from gateway.rtc3d.components import ComponentType
from gateway.takes.export.job import ExportJob
from gateway.takes.export.number_text import number_rows
from gateway.takes.export.tables import Table, table_parts
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series
from gateway.takes.files.tables import TIME_COLUMNS, Column, event_columns, time_columns, value_rows


def export_csv(job: ExportJob) -> None:
    """Write the tables of a take, whose titles have the units, such as "head x (mm)"."""
    files: dict[Table, IO[bytes]] = {}
    for table, part in table_parts(job):
        if table not in files:
            files[table] = job.files.create(table.path)
            titles = distinct(map(_title, table.columns), lambda title, _: title)
            files[table].write(_record([*TIME_COLUMNS, *titles]))
        lines = [*_lines(part)]
        files[table].write(b"\r\n".join([*lines, b""]))
        job.rows.written[table.source.name, table.key] += len(lines)


def _title(column: Column) -> str:
    return f"{column.name} ({column.unit})" if column.unit else column.name


def _lines(part: Series) -> Iterator[bytes]:
    """Yield the lines of frames or events, without their ends."""
    seconds, *numbers = time_columns(part).values()
    columns: list[Iterable[bytes]] = [
        number_rows(seconds[:, None]),
        number_rows(np.stack([column.astype(np.int64) for column in numbers], axis=1)),
    ]
    if part.component is ComponentType.EVENT:
        columns.append(
            _record(row).removesuffix(b"\r\n") for row in zip(*event_columns(part).values(), strict=True)
        )
    elif part.labels:
        columns.append(_values(value_rows(part)))
    return map(b",".join, zip(*columns, strict=True))


def _values(table: Array) -> list[bytes]:
    """Return the rows of a table of values, nothing for NaN."""
    rows = number_rows(table)
    for row in np.flatnonzero(np.isinf(table).any(axis=1)).tolist():
        rows[row] = ",".join(map(str, table[row])).replace("nan", "").encode()
    return rows


def _record(cells: Iterable[Any]) -> bytes:
    """Return a line with cells that may need quotes."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow(cells)
    return text.getvalue().encode()
