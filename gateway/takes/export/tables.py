"""The tables of an export: one for each component of each source; if its labels change, one for each set.

They are made while the take is read, so that its size does not matter.
"""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from gateway.errors import TakeError
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES
from gateway.takes.export.changed_labels import note_labels
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.files.component_rows import decode_rows
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.series import Series, SeriesBuilder
from gateway.takes.files.tables import Column, value_columns
from gateway.takes.files.take import Take, TakeSource, utime_range

_MAX_TABLES: Final = 200

_PART_US: Final = 10_000_000


@dataclass(frozen=True, eq=False)
class Table:
    """A table of an export: the component of a source, its columns of values, and the name of its file."""

    source: TakeSource
    key: str
    columns: tuple[Column, ...]
    path: Path


def table_parts(job: ExportJob) -> Iterator[tuple[Table, Series]]:
    """Yield the content of a take in parts of some MB, in its order, each with the table that it belongs to.

    Reports what was left out. Raises TakeError, also if there is nothing to export.
    """
    take = job.open_take(components=())
    tables: dict[tuple[str, str, tuple[Column, ...]], Table] = {}
    numbers: Counter[tuple[str, str]] = Counter()
    for name, key, series in chain.from_iterable(parts_of(job, take)):
        source = take.sources[name]
        job.count_recorded(name, key, len(series))
        for run in series.runs():
            columns = value_columns(run)
            table = tables.get((name, key, columns))
            if table is None:
                if len(tables) == _MAX_TABLES:
                    raise TakeError(
                        f"the labels in {job.take} change so often that there would be more than "
                        f"{_MAX_TABLES} files; choose a part by --from and --to"
                    )
                numbers[name, key] += 1
                number = numbers[name, key]
                parts = (name if len(take.sources) > 1 else "", key, str(number) if number > 1 else "")
                table = Table(source, key, columns, job.file_name(*parts))
                tables[name, key, columns] = table
                _note_columns(job, name, run, columns)
            yield table, run
    if not tables:
        raise nothing_to_export(job, "frames")
    for (name, key), count in numbers.items():
        if count > 1:
            job.note(f"the labels of {key} of {name} change: each set of labels has a file", amount=count)
    job.note_malformed(take)


def _note_columns(job: ExportJob, source: str, run: Series, columns: tuple[Column, ...]) -> None:
    """Report labels that are not in the names of the columns, such as that of the first columns."""
    if run.labels:
        fields = ITEM_DTYPES[run.component].names or ("",)
        firsts = columns[:: len(fields)]
        written = [
            column.name.removesuffix(f" {fields[0]}") if fields[0] else column.name for column in firsts
        ]
        note_labels(job, source, run, written)


def parts_of(job: ExportJob, take: Take) -> Iterator[list[tuple[str, str, Series]]]:
    """Yield parts of the take of some MB: its components, each with the name of its source and its key."""
    if take.num_recordings > 1:
        yield from _parts_in_order(job)
        return
    reader = TakeReader(job.take)
    first_utime, end_utime = utime_range(take.start_utime, job.part.from_s, job.part.to_s)
    for batches in reader.batches(end_utime):
        found = []
        for batch in batches:
            source = take.sources.get(batch.source)
            if source is None or batch.key not in COMPONENTS_BY_KEY:
                continue
            component = COMPONENTS_BY_KEY[batch.key]
            messages = batch.messages_between(first_utime, end_utime)
            if not messages:
                continue
            rows = decode_rows(component, messages)
            source.malformed[batch.key] += rows.malformed
            builder = SeriesBuilder(component)
            builder.add(rows)
            series = builder.build(source.parameters, take.start_utime)
            if series is not None:
                found.append((source.name, batch.key, series))
        yield found
        job.progress(f"writing {job.out.name}", reader.read_bytes, reader.num_bytes)
    job.progress(f"writing {job.out.name}", reader.num_bytes, reader.num_bytes)


def _parts_in_order(job: ExportJob) -> Iterator[list[tuple[str, str, Series]]]:
    """Yield what ``parts_of`` does, of several takes in one file, whose order need not be that of time."""
    take = job.open_take(COMPONENTS_BY_KEY.keys())
    every = [
        _RowsInOrder(name, key, series)
        for name, source in take.sources.items()
        for key, series in source.series.items()
    ]
    total = sum(len(each.times) for each in every)
    while waiting := [each for each in every if each.next_row < len(each.times)]:
        end_utime = min(int(each.times[each.next_row]) for each in waiting) + _PART_US
        yield [(each.source, each.key, run) for each in waiting for run in each.before(end_utime)]
        job.progress(f"writing {job.out.name}", sum(each.next_row for each in every), total)


class _RowsInOrder:
    """The rows of a series that are still to be written; a step of the clock leaves them in their order."""

    def __init__(self, source: str, key: str, series: Series) -> None:
        self.source, self.key = source, key
        self.times = np.maximum.accumulate(series.utime)
        self.next_row = 0
        self._runs = deque(series.runs())
        self._first_row = 0  # of the first run that is left

    def before(self, end_utime: int) -> Iterator[Series]:
        """Yield the rows before a time, in parts with constant labels."""
        stop = int(np.searchsorted(self.times, end_utime))
        while self.next_row < stop:
            run = self._runs[0]
            end = min(stop, self._first_row + len(run))
            yield run.rows(np.arange(self.next_row - self._first_row, end - self._first_row))
            self.next_row = end
            if end == self._first_row + len(run):
                self._first_row = end
                self._runs.popleft()
