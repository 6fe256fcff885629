"""Export to CSV: every component, written while the take is read, so that its size does not matter."""

import csv
import io
from collections import Counter
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
    files: dict[_Layout, IO[bytes]] = {}
    for name, key, series in parts_of(job, take):
        for run in series.runs():
            layout = (name, key, _columns(key, run))
            if layout not in files:
                number = 1 + sum(each[:2] == layout[:2] for each in files)
                if len(files) == _MAX_FILES:
                    raise TakeError(
                        f"the labels in {job.take} change so often that there would be more than "
                        f"{_MAX_FILES} files; choose a part by --from and --to"
                    )
                parts = (name if len(take.sources) > 1 else "", key, str(number) if number > 1 else "")
                files[layout] = job.files.create(job.file_name(*parts))
                files[layout].write(_line([*_HEAD, *layout[2]]).encode())
            files[layout].writelines(row.encode() for row in _rows(key, run))
    if not files:
        raise nothing_to_export(job, "frames")
    for (name, key), count in Counter(layout[:2] for layout in files).items():
        if count > 1:
            job.note(f"the labels of {key} of {name} change: each set of labels has a file", amount=count)
    job.note_malformed(take)


def parts_of(job: ExportJob, take: Take) -> Iterator[tuple[str, str, Series]]:
    """Yield parts of the components of some MB, with the names of their sources, in the order of the take."""
    reader = TakeReader(job.take)
    first, stop = job.utimes(take)
    for batches in reader.batches():
        for batch in batches:
            source = take.sources.get(batch.source)
            if source is None or batch.key not in COMPONENTS_BY_KEY:
                continue
            component = COMPONENTS_BY_KEY[batch.key]
            events = zip(batch.utimes, batch.messages, strict=True)
            messages = [message for utime, message in events if first <= utime < stop]
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


def _rows(key: str, run: Series) -> Iterator[str]:
    """Yield the lines of frames or events.

    Values are the shortest texts that mean the same 32-bit numbers, and nothing for NaN.
    """
    columns = [getattr(run, name).tolist() for name in _HEAD[1:]]
    for row, (seconds, *numbers) in enumerate(zip(run.seconds.tolist(), *columns, strict=True)):
        head = f"{seconds:.6f}," + ",".join(map(str, numbers))
        if key == ComponentType.EVENT.key:
            item = run.items[row]
            text = event_text(run.parameters_of(row), item)
            cells = [item["id"], text.label, item["timestamp"], *(item[f"param{n}"] for n in (1, 2, 3))]
            yield f"{head},{_line([*map(str, cells), text.description])}"
        else:
            values = run.values[row].ravel()
            cells_text = ",".join(map(str, values)).replace("nan", "")
            yield f"{head},{cells_text}\r\n" if len(values) else f"{head}\r\n"


def _line(cells: list[str]) -> str:
    """Return a line of RFC 4180."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow(cells)
    return text.getvalue()
