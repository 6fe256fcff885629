"""Export to CSV: one file per component, written while the take is read, so that its size does not matter."""

import csv
import io
import math
from collections.abc import Iterator
from typing import IO, Final

from gateway.descriptions.labels import event_text
from gateway.errors import TakeError
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.files.component_rows import decode_rows
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.series import Series, SeriesBuilder
from gateway.takes.files.take import Take

_HEAD: Final = ("time_s", "capture_utime", "utime", "sequence", "session", "frame_number", "timestamp_us")
_EVENT_FIELDS: Final = ("id", "label", "event_timestamp_us", "param1", "param2", "param3", "description")
_QUATERNION: Final = ("q0", "qx", "qy", "qz")
_MOMENTS: Final = ("mx", "my", "mz")
_MAX_FILES: Final = 200

_Layout = tuple[str, str, tuple[str, ...]]  # source, key and columns of a file


def export_csv(job: ExportJob) -> None:
    """Write a file for each component of each source; if its labels change, one for each set of labels."""
    take = job.open_take(components=())
    writer = _Writer(job, take)
    for name, key, series in _parts(job, take):
        for run in series.runs():
            writer.write(name, key, run)
    if not job.files.paths:
        raise nothing_to_export(job, "frames")
    writer.note_changes()
    job.note_malformed(take)


class _Writer:
    """Writes rows to the files of their components."""

    def __init__(self, job: ExportJob, take: Take) -> None:
        self._job = job
        self._has_sources = len(take.sources) > 1
        self._files: dict[_Layout, IO[bytes]] = {}

    def write(self, name: str, key: str, run: Series) -> None:
        """Append the rows of a run."""
        columns = _columns(key, run)
        layout = (name, key, columns)
        if layout not in self._files:
            self._files[layout] = self._create(name, key, columns)
        rows = _event_rows(run) if key == ComponentType.EVENT.key else _value_rows(run)
        self._files[layout].writelines(row.encode() for row in rows)

    def note_changes(self) -> None:
        """Report components that have several files."""
        for name, key in dict.fromkeys((name, key) for name, key, _ in self._files):
            count = self._number_of(name, key)
            if count > 1:
                self._job.note(f"the labels of {key} of {name} change, so there are {count} files of it")

    def _create(self, name: str, key: str, columns: tuple[str, ...]) -> IO[bytes]:
        if len(self._files) == _MAX_FILES:
            raise TakeError(
                f"the labels in {self._job.take} change so often that there would be more than {_MAX_FILES} "
                "files; choose a part by --from and --to"
            )
        number = self._number_of(name, key) + 1
        parts = (name if self._has_sources else "", key, str(number) if number > 1 else "")
        file = self._job.files.create(self._job.file_name(*parts))
        file.write(_line([*_HEAD, *columns]).encode())
        return file

    def _number_of(self, name: str, key: str) -> int:
        return sum(layout[:2] == (name, key) for layout in self._files)


def _parts(job: ExportJob, take: Take) -> Iterator[tuple[str, str, Series]]:
    """Yield parts of the components of some MB, with the names of their sources, in the order of the take."""
    reader = TakeReader(job.take)
    first = -math.inf if job.from_s is None else take.start_utime + round(job.from_s * 1e6)
    end = math.inf if job.to_s is None else take.start_utime + round(job.to_s * 1e6)
    for batches in reader.batches():
        for batch in batches:
            source = take.sources.get(batch.source)
            if source is None or batch.key not in COMPONENTS_BY_KEY:
                continue
            component = COMPONENTS_BY_KEY[batch.key]
            events = zip(batch.utimes, batch.messages, strict=True)
            messages = [message for utime, message in events if first <= utime < end]
            if not messages:
                continue
            rows = decode_rows(component, messages)
            source.malformed[batch.key] = source.malformed.get(batch.key, 0) + rows.malformed
            builder = SeriesBuilder(component)
            builder.add(rows)
            series = builder.build(source.parameters, take.start_utime)
            if series is not None:
                yield source.name, batch.key, series
        job.progress(f"reading {job.take.name}", reader.read_bytes, reader.num_bytes)


def _columns(key: str, run: Series) -> tuple[str, ...]:
    """Return the titles of the values' columns, such as "head x (mm)"."""
    if key == ComponentType.EVENT.key:
        return _EVENT_FIELDS
    fields = ITEM_DTYPES[COMPONENTS_BY_KEY[key]].names
    if fields is None:
        return tuple(_title(label, unit) for label, unit in zip(run.labels, run.units, strict=True))
    titles = []
    for label, unit in zip(run.labels, run.units, strict=True):
        for field in fields:
            field_unit = run.moment_unit if field in _MOMENTS else unit
            titles.append(_title(f"{label} {field}", "" if field in _QUATERNION else field_unit))
    return tuple(titles)


def _title(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _heads(run: Series) -> Iterator[str]:
    """Yield the cells of ``_HEAD`` of each row."""
    columns = [getattr(run, name).tolist() for name in _HEAD[1:]]
    for seconds, *numbers in zip(run.seconds.tolist(), *columns, strict=True):
        yield f"{seconds:.6f}," + ",".join(map(str, numbers))


def _value_rows(run: Series) -> Iterator[str]:
    """Yield the lines of frames: the shortest texts that mean the same 32-bit numbers, nothing for NaN."""
    values = run.values.reshape(len(run), -1)
    for head, row in zip(_heads(run), values, strict=True):
        cells = ",".join(map(str, row)).replace("nan", "")
        yield f"{head},{cells}\r\n" if len(row) else f"{head}\r\n"


def _event_rows(run: Series) -> Iterator[str]:
    """Yield the lines of events."""
    for number, head in enumerate(_heads(run)):
        item = run.items[number]
        text = event_text(run.parameters_of(number), item)
        cells = [item["id"], text.label, item["timestamp"], *(item[f"param{n}"] for n in (1, 2, 3))]
        yield f"{head},{_line([*map(str, cells), text.description])}"


def _line(cells: list[str]) -> str:
    """Return a line of RFC 4180."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow(cells)
    return text.getvalue()
