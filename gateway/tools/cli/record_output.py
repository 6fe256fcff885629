"""What ``record`` prints: its progress, what goes wrong, and the table at the end."""

import contextlib
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Final, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.client.completion_states import Unknown
from gateway.client.reception import MAX_SERIES
from gateway.client.recorder import FileWriter, RecordedSeries, RecordedSource, TakeRecording
from gateway.client.sources import POSE, ReceivedSeries
from gateway.client.transport import GatewaySubscriber
from gateway.messages.topics import MAX_SOURCES
from gateway.runtime.quantities import size_text
from gateway.runtime.safe_text import safe_text

SILENCE_S: Final = 2.0
_NO_DATA_S: Final = 3.0
_TERMINAL_S: Final = 0.5
_LINE_S: Final = 5.0
_CHECK_S: Final = 1.0
_SLOW_BYTES: Final = 8 * 1024 * 1024
"""If more than this waits for the disk, it is too slow."""

_MAX_LOSS_LINES: Final = 20


class RecordProgress:
    """Writes to stderr: on a terminal, a line that changes; otherwise, one line every few seconds.

    If it is ``quiet``, it writes only what goes wrong.
    """

    def __init__(
        self, recording: TakeRecording, subscriber: GatewaySubscriber, wanted: list[str], *, quiet: bool
    ) -> None:
        self._recording = recording
        self._subscriber = subscriber
        self._wanted = wanted
        self._quiet = quiet
        self._start_s = self._checked_s = self._shown_s = time.monotonic()
        self._former = (0, 0)  # messages and bytes, when the line was shown last
        self._disk_problem = ""
        self._is_slow = False
        self._num_lost = 0
        self._num_refused = 0
        self._num_loss_lines = 0
        self._reported: set[str] = set()  # what was reported and still holds
        console = Console(stderr=True)
        self._live: Live | None = None
        if console.is_terminal and not quiet:
            self._live = Live(Text(""), console=console, auto_refresh=False, transient=True)
            self._live.start()

    def tick(self) -> None:
        """Report what is new. Call it often."""
        now_s = time.monotonic()
        self._check_disk()
        if now_s - self._checked_s >= _CHECK_S:
            self._checked_s = now_s
            self._check_losses()
            self._check_silence(now_s)
        if not self._quiet and now_s - self._shown_s >= (_LINE_S if self._live is None else _TERMINAL_S):
            line = self._line(now_s)
            self._shown_s = now_s
            if self._live is None:
                self._print(line)
            else:
                self._live.update(Text(safe_text(line), no_wrap=True, overflow="ellipsis"), refresh=True)

    def close(self) -> None:
        """Remove the line."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _print(self, text: str) -> None:
        if self._live is not None:
            self._live.console.print(Text(safe_text(text)))
            return
        with contextlib.suppress(OSError, ValueError):  # nobody reads it: the recording goes on
            print(safe_text(text), file=sys.stderr, flush=True)

    def _check_disk(self) -> None:
        file = self._recording.file
        problem = "" if file is None else file.problem
        if problem != self._disk_problem:
            self._disk_problem = problem
            waits = f"{problem}; up to 64 MB wait in memory until the disk has room again"
            self._print(waits if problem else "the disk accepts what is written again")
        queued_bytes = self._recording.queued_bytes
        if self._is_slow:
            self._is_slow = queued_bytes > _SLOW_BYTES // 2
        elif queued_bytes > _SLOW_BYTES and not problem:
            self._is_slow = True
            self._print(f"the disk is too slow: {size_text(queued_bytes)} wait to be written")

    def _check_losses(self) -> None:
        all_series = self._recording.all_series
        num_lost = sum(series.check.num_lost for series in all_series)
        num_refused = sum(series.num_refused for series in all_series)
        if num_lost > self._num_lost:
            self._print_loss(f"{num_lost - self._num_lost} messages were lost on the way; {num_lost} so far")
        if num_refused > self._num_refused:
            text = "messages were not written, because too many wait for the disk"
            self._print_loss(f"{num_refused - self._num_refused} {text}; {num_refused} so far")
        self._num_lost, self._num_refused = num_lost, num_refused
        for source in self._recording.sources_now:
            if any(series.check.has_two_publishers for series in source.series):
                self._report(
                    f"two gateways publish the source {source.name}: give one of them another name, "
                    "or record through one only; both are recorded"
                )

    def _print_loss(self, text: str) -> None:
        self._num_loss_lines += 1
        if self._num_loss_lines < _MAX_LOSS_LINES:
            self._print(text)
        elif self._num_loss_lines == _MAX_LOSS_LINES:
            self._print(f"{text}; further losses are in the table at the end")

    def _check_silence(self, now_s: float) -> None:
        sources = [source for source in self._recording.sources_now if source.heard_s is not None]
        missing = set(self._wanted) - {source.name for source in sources}
        if (
            now_s - self._start_s >= SILENCE_S
            and (missing or not sources)
            and "missing" not in self._reported
        ):
            problem = self._subscriber.silence()
            if problem:
                self._reported.add("missing")
                self._print(problem)
        for source in sources:
            assert source.heard_s is not None  # noqa: S101 - see above
            text = f"{source.name}: nothing has arrived for 2 s; is its gateway running?"
            if now_s - source.heard_s >= SILENCE_S:
                self._report(text)
            else:
                self._reported.discard(text)
                self._check_streams(source, now_s)

    def _check_streams(self, source: RecordedSource, now_s: float) -> None:
        """Report why there are no frames, if the gateway itself gets none."""
        if source.num_data or now_s - self._start_s < _NO_DATA_S or source.name in self._reported:
            return
        status = source.decoded_status()
        if status is None or any(stream.state == "streaming" for stream in status.streams):
            return
        self._reported.add(source.name)
        for stream in status.streams:
            error = f": {stream.last_error}" if stream.last_error else ""
            self._print(
                f"{source.name}: the gateway gets no frames from {status.server}: {stream.state}{error}"
            )

    def _report(self, text: str) -> None:
        """Print a text, unless that was done already."""
        if text not in self._reported:
            self._reported.add(text)
            self._print(text)

    def _line(self, now_s: float) -> str:
        recording, file = self._recording, self._recording.file
        elapsed_s = max(now_s - self._shown_s, 1e-3)
        former_messages, former_bytes = self._former
        self._former = (recording.num_messages, recording.num_bytes)
        minutes, seconds = divmod(int(now_s - self._start_s), 60)
        num_incomplete = 0 if recording.refill is None else recording.refill.num_incomplete
        parts = [
            f"{minutes}:{seconds:02}",
            "waiting for messages" if file is None else size_text(file.num_bytes),
            f"{(recording.num_messages - former_messages) / elapsed_s:.0f} messages/s",
            f"{size_text((recording.num_bytes - former_bytes) / elapsed_s)}/s",
            f"{self._num_lost} lost" if self._num_lost else "no gaps",
            *([f"{num_incomplete} keys are refilled"] if num_incomplete else []),
            f"{size_text(recording.queued_bytes)} to be written",
        ]
        return "  ".join(parts)


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
