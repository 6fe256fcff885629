"""The table that ``record`` prints at its end, and why a recording is not complete."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Final, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.client.completion_states import Unknown
from gateway.client.reception import MAX_SERIES
from gateway.client.recorder import FileWriter, RecordedSeries, TakeRecording
from gateway.client.sources import POSE, ReceivedSeries
from gateway.messages.topics import MAX_SOURCES
from gateway.runtime.quantities import size_text
from gateway.runtime.safe_text import safe_text

_ORDER: Final = ("3d", "6d", f"{POSE}*", "analog", "force", "event", "status", "clock", "parameters")
_MAX_NOTES: Final = 10
_MAX_RANGES: Final = 3
_COLUMNS: Final = ("messages", "size", "rate", "refilled", "lost", "not written")


def print_summary(recording: TakeRecording, out: TextIO) -> bool:
    """Print what was recorded, and return whether the recording is complete.

    It is if it has a message of a frame, and none that was published meanwhile is missing.
    """
    console = Console(file=out)
    file = recording.file
    if file is None:
        console.print(Text("nothing was recorded, and there is no file: no message has arrived"))
        return False
    table = Table("source", "component", box=None, pad_edge=False)
    for column in _COLUMNS:
        table.add_column(column, justify="right")
    for source in recording.sources_now:
        rows: defaultdict[str, list[RecordedSeries]] = defaultdict(list)
        for series in source.series:
            if series.is_recorded and series.num_messages:
                rows[series.row].append(series)
        for row in sorted(rows, key=_ORDER.index):
            table.add_row(Text(safe_text(source.name)), row, *_cells(rows[row], file))
    console.print(table)
    problems = [*_problems(recording, file)]
    notes = [*_notes(recording)]
    if len(notes) > _MAX_NOTES:
        notes[_MAX_NOTES:] = [f"… and {len(notes) - _MAX_NOTES} notes on other sources"]
    for note in (*notes, *problems):
        console.print(Text(safe_text(note)), soft_wrap=True)
    end = "INCOMPLETE" if problems else "complete: no gaps"
    console.print(Text(f"{file.path}: {size_text(file.num_bytes)}, {end}"), soft_wrap=True)
    return not problems


def _cells(series: Sequence[RecordedSeries], file: FileWriter) -> Iterator[str]:
    """Yield the cells of _COLUMNS for some series together."""
    num_unwritten = sum(each.num_refused + file.lost[each.channel] for each in series)
    num_unwritten_bytes = sum(each.num_refused_bytes + file.lost_bytes[each.channel] for each in series)
    yield str(sum(each.num_messages for each in series) - num_unwritten)
    yield size_text(sum(each.num_bytes for each in series) - num_unwritten_bytes)
    yield f"{sum(_rate_hz(each) for each in series):.1f} Hz"
    num_refilled = sum(each.completion.num_refilled for each in series if each.completion is not None)
    num_lost = sum(each.check.num_lost for each in series)
    for number in (num_refilled, num_lost, num_unwritten):
        yield str(number) if number else "-"


def _rate_hz(series: RecordedSeries) -> float:
    duration_us = series.last_utime - series.first_utime
    return 1e6 * (series.num_messages - 1) / duration_us if duration_us > 0 else 0.0


def _problems(recording: TakeRecording, file: FileWriter) -> Iterator[str]:
    """Yield why the recording is not complete."""
    if not any(source.num_data for source in recording.sources_now):
        yield "no frame was recorded"
    yield from _losses(recording)
    if file.lost:
        yield f"{file.lost.total()} messages were not written: {file.problem}"
    elif file.problem:
        yield file.problem
    elif file.is_unsafe:
        yield "the disk reported errors: the file may be damaged"
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
    yield from missing_texts(all_series)
    yield from unknown_texts(all_series)
    for source in recording.sources_now:
        if any(series.check.has_two_publishers for series in source.series):
            yield (
                f"two gateways publish the source {source.name}, so losses cannot be counted exactly; "
                "give one of them another name"
            )
    num_refused = sum(series.num_refused for series in all_series)
    if num_refused:
        yield f"{num_refused} messages were not written, because too many waited for the disk"


def missing_texts(all_series: Sequence[ReceivedSeries]) -> Iterator[str]:
    """Yield how many messages of these series are missing, and which; nothing if none is."""
    incomplete = [series for series in all_series if series.check.num_lost]
    if incomplete:
        num_lost = sum(series.check.num_lost for series in incomplete)
        yield f"{num_lost} messages were lost between the gateway and this computer, or in the gateway"
        yield from map(_missing_text, incomplete[:_MAX_NOTES])
    if len(incomplete) > _MAX_NOTES:
        yield f"… and {len(incomplete) - _MAX_NOTES} other keys"


_UNKNOWN_TEXTS: Final = {
    Unknown.RESTART: "its gateway was started again ({}), and it is not known what is missing before that",
    Unknown.TWO_GATEWAYS: "two gateways published it for a while ({}): it is not known what is missing then",
    Unknown.BEGINNING: "it is not known what is missing before the first message of {} keys, because the "
    "gateway's history has not answered",
    Unknown.END: "it is not known what is missing at the end of {} keys, because the gateway's history has "
    "not answered",
}


def unknown_texts(all_series: Sequence[ReceivedSeries]) -> Iterator[str]:
    """Yield of which parts of the sources it is not known whether something is missing."""
    names = dict.fromkeys(series.source.name for series in all_series)
    texts = []
    for name in names:
        series = [each for each in all_series if each.source.name == name]
        for unknown, text in _UNKNOWN_TEXTS.items():
            counts = [each.completion.unknown[unknown] for each in series if each.completion is not None]
            if unknown is Unknown.RESTART:
                counts += [each.check.num_restarts for each in series]
            is_of_keys = unknown in {Unknown.BEGINNING, Unknown.END}
            count = sum(map(bool, counts)) if is_of_keys else max(counts, default=0)
            if count:
                texts.append(f"{name}: {text.format(count if is_of_keys else _times(count))}")
    yield from texts[:_MAX_NOTES]
    if len(texts) > _MAX_NOTES:
        yield f"… and {len(texts) - _MAX_NOTES} such notes on other sources"


def _missing_text(series: ReceivedSeries) -> str:
    """Return which messages of a series are missing, and why, if that is known."""
    gaps = series.check.gaps
    ranges = [
        f"{gap.stop - gap.missing} to {gap.stop - 1}" if gap.missing > 1 else str(gap.stop - 1)
        for gap in gaps[:_MAX_RANGES]
    ]
    more = series.check.num_gaps - len(ranges)
    others = f" and {more} other places" if more else ""
    problem = series.completion.last_problem if series.completion is not None else ""
    reason = f" ({problem})" if problem else ""
    return f"{series.source.name} {series.key}: the messages {', '.join(ranges)}{others} are missing{reason}"


def _notes(recording: TakeRecording) -> Iterator[str]:
    """Yield what is worth knowing, although nothing is missing because of it."""
    if recording.num_foreign:
        yield (
            f"{recording.num_foreign} messages on these keys or channels were not recorded: they are none of "
            "this version's types; does another program, or another version of the gateway, publish there?"
        )
    if recording.file is not None and recording.file.num_errors and not recording.file.problem:
        yield f"the disk did not accept what was written for a while ({_times(recording.file.num_errors)})"
    for source in recording.sources_now:
        checks = [series.check for series in source.series]
        damaged = sum(each.completion.num_damaged for each in source.series if each.completion is not None)
        if damaged:
            yield (
                f"{source.name}: {damaged} messages were left out, because the gateway has not published "
                "their numbers; does another program publish there?"
            )
        late = sum(check.num_late for check in checks if not check.has_two_publishers)
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
