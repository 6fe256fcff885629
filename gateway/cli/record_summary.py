"""The table that ``record`` prints at the end, and whether the recording is complete."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.cli.record_progress import size_text
from gateway.recorder.file_sink import FileSink
from gateway.recorder.series import RecordedSeries, RecordedSource
from gateway.recorder.take_recording import TakeRecording
from gateway.safe_text import safe_text
from gateway.subscriber.reception import MAX_SERIES, MAX_SOURCES
from gateway.subscriber.series import POSE

_ORDER: Final = ("3d", "6d", f"{POSE}*", "analog", "force", "event", "status", "clock", "parameters")
_MAX_NOTES: Final = 10
_COLUMNS: Final = ("messages", "size", "rate", "gaps", "lost", "not written")


class SeriesCounts(NamedTuple):
    """What was recorded of one component of a source. ``num_unwritten`` messages are not in the file."""

    num_messages: int
    num_bytes: int
    rate_hz: float
    num_gaps: int
    num_lost: int
    num_unwritten: int


def counts_of(series: Sequence[RecordedSeries], sink: FileSink) -> SeriesCounts:
    """Return the counts of some series together."""
    num_unwritten = sum(each.num_refused + sink.lost[each.channel] for each in series)
    num_messages = sum(each.num_messages for each in series)
    return SeriesCounts(
        num_messages - num_unwritten,
        sum(each.num_bytes - each.num_refused_bytes - sink.lost_bytes[each.channel] for each in series),
        sum(_rate_hz(each) for each in series),
        sum(each.check.num_gaps for each in series),
        sum(each.check.num_lost for each in series),
        num_unwritten,
    )


def _rate_hz(series: RecordedSeries) -> float:
    duration_us = series.check.last_utime - series.check.first_utime
    return 1e6 * (series.num_messages - 1) / duration_us if duration_us > 0 else 0.0


def print_summary(recording: TakeRecording, out: TextIO) -> bool:
    """Print what was recorded, and return whether the recording is complete.

    It is if it has a message of a frame, and none that was published meanwhile is missing.
    """
    console = Console(file=out)
    sink = recording.sink
    if sink is None:
        console.print(Text("nothing was recorded, and there is no file: no message has arrived"))
        return False
    table = Table("source", "component", box=None, pad_edge=False)
    for column in _COLUMNS:
        table.add_column(column, justify="right")
    for source in recording.sources_now:
        for row, series in _rows(source):
            counts = counts_of(series, sink)
            table.add_row(
                Text(safe_text(source.name)),
                row,
                str(counts.num_messages),
                size_text(counts.num_bytes),
                f"{counts.rate_hz:.1f} Hz",
                *(str(number) if number else "-" for number in counts[3:]),
            )
    console.print(table)
    problems = [*_problems(recording)]
    notes = [*_notes(recording)]
    if len(notes) > _MAX_NOTES:
        notes[_MAX_NOTES:] = [f"… and {len(notes) - _MAX_NOTES} notes on other sources"]
    for note in (*notes, *problems):
        console.print(Text(safe_text(note)), soft_wrap=True)
    end = "INCOMPLETE" if problems else "complete: no gaps"
    console.print(Text(f"{sink.path}: {size_text(sink.num_bytes)}, {end}"), soft_wrap=True)
    return not problems


def _rows(source: RecordedSource) -> Iterator[tuple[str, list[RecordedSeries]]]:
    rows: defaultdict[str, list[RecordedSeries]] = defaultdict(list)
    for series in source.series:
        if series.is_recorded and series.num_messages:
            rows[series.row].append(series)
    for row in sorted(rows, key=_ORDER.index):
        yield row, rows[row]


def _problems(recording: TakeRecording) -> Iterator[str]:
    """Yield why the recording is not complete."""
    if not any(source.num_data for source in recording.sources_now):
        yield "no frame was recorded"
    yield from _losses(recording)
    if recording.sink is not None:
        yield from _disk_problems(recording.sink)
    if recording.is_moved:
        yield "the file was moved or deleted while it was recorded"
    if recording.defect is not None:
        yield (
            f"{recording.num_defects} messages were not recorded because of a defect in rtc3d-gateway: "
            f"{type(recording.defect).__name__}: {recording.defect}; report this"
        )
    if recording.num_beyond:
        yield (
            f"{recording.num_beyond} messages were not recorded: there are more than {MAX_SOURCES} sources "
            f"or {MAX_SERIES} keys; choose some with --source and --component"
        )


def _losses(recording: TakeRecording) -> Iterator[str]:
    all_series = [series for series in recording.all_series if series.is_recorded]
    num_lost = sum(series.check.num_lost for series in all_series)
    if num_lost:
        yield f"{num_lost} messages were lost between the gateway and this computer, or in the gateway"
    for source in recording.sources_now:
        if any(series.check.has_two_publishers for series in source.series):
            yield (
                f"two gateways publish the source {source.name}, so losses cannot be counted exactly; "
                "give one of them another name"
            )
    num_refused = sum(series.num_refused for series in all_series)
    if num_refused:
        yield f"{num_refused} messages were not written, because too many waited for the disk"


def _disk_problems(sink: FileSink) -> Iterator[str]:
    if sink.lost:
        yield f"{sink.lost.total()} messages were not written: {sink.problem}"
    elif sink.problem:
        yield sink.problem
    elif sink.is_unsafe:
        yield "the disk reported errors: the file may be damaged"


def _notes(recording: TakeRecording) -> Iterator[str]:
    """Yield what is worth knowing, although nothing is missing because of it."""
    if recording.num_foreign:
        yield (
            f"{recording.num_foreign} messages on these keys or channels were not recorded: they are none of "
            "this version's types; does another program, or another version of the gateway, publish there?"
        )
    if recording.sink is not None and recording.sink.num_errors and not recording.sink.problem:
        yield f"the disk did not accept what was written for a while ({_times(recording.sink.num_errors)})"
    for source in recording.sources_now:
        checks = [series.check for series in source.series]
        restarts = max((check.num_restarts for check in checks), default=0)
        if restarts:
            yield f"{source.name}: its gateway was started again ({_times(restarts)})"
        late = sum(check.num_alternations for check in checks if not check.has_two_publishers)
        if late:
            yield f"{source.name}: {late} messages came in another order than they were sent"
        repeated = sum(check.num_repeated for check in checks)
        if repeated:
            yield f"{source.name}: {repeated} messages came twice; both are recorded"
        if source.num_data and source.parameters is None:
            yield (
                f"{source.name}: its parameters were not published, so the recording has no labels; "
                "see `rtc3d-gateway params`"
            )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
