"""Export to Parquet: a file for each component, with units and what is known about the take as metadata.

Values are stored plainly, because not every reader knows the newer encodings, and compressed by Snappy, which
all know. NaN stays NaN, so that no column needs a mask.
"""

import json
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gateway.rtc3d.components import ComponentType
from gateway.takes.export.job import ExportJob
from gateway.takes.export.tables import Table, table_parts
from gateway.takes.files.series import Series
from gateway.takes.files.tables import event_columns, time_columns, units_by_column, value_rows

_MAX_WAITING_BYTES: Final = 32 * 1024 * 1024
"""How much of all tables waits in memory for larger row groups; then that of the largest is written."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def export_parquet(job: ExportJob) -> None:
    """Write the tables of a take, each in row groups of some MB."""
    files: dict[Table, _TableFile] = {}
    with ExitStack() as open_files:
        for table, part in table_parts(job):
            batch = _record_batch(table, part)
            if table not in files:
                writer = pq.ParquetWriter(job.files.create(table.path), batch.schema, use_dictionary=False)
                files[table] = _TableFile(open_files.enter_context(writer))
            files[table].add(batch)
            job.rows.written[table.source.name, table.key] += batch.num_rows
            if sum(file.waiting_bytes for file in files.values()) > _MAX_WAITING_BYTES:
                max(files.values(), key=lambda file: file.waiting_bytes).write_row_group()
        for file in files.values():
            file.write_row_group()


class _TableFile:
    """A file that is being written, and the rows that wait for its next row group."""

    def __init__(self, writer: pq.ParquetWriter) -> None:
        self.waiting_bytes = 0
        self._writer = writer
        self._waiting: list[pa.RecordBatch] = []

    def add(self, batch: pa.RecordBatch) -> None:
        self._waiting.append(batch)
        self.waiting_bytes += batch.nbytes

    def write_row_group(self) -> None:
        if self._waiting:
            rows = pa.Table.from_batches(self._waiting)
            self._writer.write_table(rows, row_group_size=len(rows))
            self._waiting, self.waiting_bytes = [], 0


def _record_batch(table: Table, part: Series) -> pa.RecordBatch:
    """Return rows of a table; their schema has its metadata."""
    columns: dict[str, Any] = dict(time_columns(part))
    if part.component is ComponentType.EVENT:
        columns |= {name: pa.array(values) for name, values in event_columns(part).items()}
    else:
        by_column = np.ascontiguousarray(value_rows(part).T)
        columns |= {column.name: values for column, values in zip(table.columns, by_column, strict=True)}
    arrays = [pa.array(values) for values in columns.values()]
    units = units_by_column(table.columns)
    fields = [
        pa.field(name, array.type, nullable=False, metadata={"unit": units[name]} if name in units else None)
        for name, array in zip(columns, arrays, strict=True)
    ]
    about = _about(table, part.start_utime)
    # pandas reads its own key into DataFrame.attrs.
    metadata = about | {"PANDAS_ATTRS": json.dumps(about | {"units": units})}
    return pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields, metadata))


def _about(table: Table, start_utime: int) -> dict[str, str]:
    """Return what is known about the take and the source; what is not known is missing."""
    source = table.source
    try:
        start_time = (_EPOCH + timedelta(microseconds=start_utime)).isoformat(timespec="microseconds")
    except OverflowError:
        start_time = ""
    about = {
        "source": source.name,
        "component": table.key,
        "server": source.server,
        "gateway_version": source.gateway_version,
        **source.details._asdict(),
        "start_utime": str(start_utime),
        "start_time": start_time.replace("+00:00", "Z"),
    }
    return {name: text for name, text in about.items() if text}
