"""What ``record`` prints while it runs: its progress, and what goes wrong."""

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gateway.client.recorder import RecordedSource, TakeRecording
from gateway.client.transport import GatewaySubscriber
from gateway.runtime.quantities import size_text
from gateway.runtime.safe_text import safe_text

SILENCE_S: Final = 2.0
_NO_DATA_S: Final = 3.0
_CHECK_S: Final = 1.0


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
        self._start_s = self._checked_s = time.monotonic()
        self._output = _ProgressOutput(quiet=quiet)
        self._former = (0, 0)  # messages and bytes, when the line was shown last
        self._disk = _DiskReports()
        self._losses = _LossReports()
        self._reported: set[str] = set()  # what was reported and still holds

    def tick(self) -> None:
        """Report what is new. Call it often."""
        now_s = time.monotonic()
        for text in self._disk.new_texts(self._recording):
            self._output.print(text)
        if now_s - self._checked_s >= _CHECK_S:
            self._checked_s = now_s
            for text in self._losses.new_texts(self._recording):
                self._output.print(text)
            self._check_publishers()
            self._check_silence(now_s)
        if self._output.is_line_due(now_s):
            self._output.show(self._line(now_s), now_s)

    def close(self) -> None:
        """Remove the line."""
        self._output.close()

    def _check_publishers(self) -> None:
        for source in self._recording.sources_now:
            if any(series.check.has_two_publishers for series in source.series):
                self._report(
                    f"two gateways publish the source {source.name}: give one of them another name, "
                    "or record through one only; both are recorded"
                )

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
                self._output.print(problem)
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
            self._output.print(
                f"{source.name}: the gateway gets no frames from {status.server}: {stream.state}{error}"
            )

    def _report(self, text: str) -> None:
        """Print a text, unless that was done already."""
        if text not in self._reported:
            self._reported.add(text)
            self._output.print(text)

    def _line(self, now_s: float) -> str:
        recording, file = self._recording, self._recording.file
        elapsed_s = max(now_s - self._output.shown_s, 1e-3)
        former_messages, former_bytes = self._former
        self._former = (recording.num_messages, recording.num_bytes)
        minutes, seconds = divmod(int(now_s - self._start_s), 60)
        num_incomplete = 0 if recording.refill is None else recording.refill.num_incomplete
        parts = [
            f"{minutes}:{seconds:02}",
            "waiting for messages" if file is None else size_text(file.num_bytes),
            f"{(recording.num_messages - former_messages) / elapsed_s:.0f} messages/s",
            f"{size_text((recording.num_bytes - former_bytes) / elapsed_s)}/s",
            f"{self._losses.num_lost} lost" if self._losses.num_lost else "no gaps",
            *([f"{num_incomplete} keys are refilled"] if num_incomplete else []),
            f"{size_text(recording.queued_bytes)} to be written",
        ]
        return "  ".join(parts)


_TERMINAL_S: Final = 0.5
_LINE_S: Final = 5.0


class _ProgressOutput:
    """The line that shows the progress, and lines above it that stay."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self.shown_s = time.monotonic()
        """When the line was shown last."""
        console = Console(stderr=True)
        self._live: Live | None = None
        if console.is_terminal and not quiet:
            self._live = Live(Text(""), console=console, auto_refresh=False, transient=True)
            self._live.start()

    def is_line_due(self, now_s: float) -> bool:
        """Return whether to show the line again: more often on a terminal, and never if it is quiet."""
        return not self._quiet and now_s - self.shown_s >= (_LINE_S if self._live is None else _TERMINAL_S)

    def show(self, line: str, now_s: float) -> None:
        """Show the line instead of the former one; without a terminal, below it."""
        self.shown_s = now_s
        if self._live is None:
            self.print(line)
        else:
            self._live.update(Text(safe_text(line), no_wrap=True, overflow="ellipsis"), refresh=True)

    def print(self, text: str) -> None:
        """Print a line that stays."""
        if self._live is not None:
            self._live.console.print(Text(safe_text(text)))
            return
        with contextlib.suppress(OSError, ValueError):  # nobody reads it: the recording goes on
            print(safe_text(text), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the line."""
        if self._live is not None:
            self._live.stop()
            self._live = None


_SLOW_BYTES: Final = 8 * 1024 * 1024
"""If more than this waits for the disk, it is too slow."""


class _DiskReports:
    """Reports when the disk does not accept what is written, when it does again, and when it is too slow."""

    def __init__(self) -> None:
        self._problem = ""
        self._is_slow = False

    def new_texts(self, recording: TakeRecording) -> Iterator[str]:
        """Yield what has changed since the last call."""
        problem = "" if recording.file is None else recording.file.problem
        if problem != self._problem:
            self._problem = problem
            waits = f"{problem}; up to 64 MB wait in memory until the disk has room again"
            yield waits if problem else "the disk accepts what is written again"
        queued_bytes = recording.queued_bytes
        if self._is_slow:
            self._is_slow = queued_bytes > _SLOW_BYTES // 2
        elif queued_bytes > _SLOW_BYTES and not problem:
            self._is_slow = True
            yield f"the disk is too slow: {size_text(queued_bytes)} wait to be written"


_MAX_LOSS_LINES: Final = 20


class _LossReports:
    """Reports how many more messages were lost, in a limited number of lines."""

    def __init__(self) -> None:
        self.num_lost = 0
        """How many messages were lost on the way, as of the last call of ``new_texts``."""
        self._num_refused = 0
        self._num_lines = 0

    def new_texts(self, recording: TakeRecording) -> Iterator[str]:
        """Yield what was lost since the last call."""
        for text in self._new_losses(recording):
            self._num_lines += 1
            if self._num_lines < _MAX_LOSS_LINES:
                yield text
            elif self._num_lines == _MAX_LOSS_LINES:
                yield f"{text}; further losses are in the table at the end"

    def _new_losses(self, recording: TakeRecording) -> list[str]:
        all_series = recording.all_series
        num_lost = sum(series.check.num_lost for series in all_series)
        num_refused = sum(series.num_refused for series in all_series)
        texts = []
        if num_lost > self.num_lost:
            texts.append(f"{num_lost - self.num_lost} messages were lost on the way; {num_lost} so far")
        if num_refused > self._num_refused:
            text = "messages were not written, because too many wait for the disk"
            texts.append(f"{num_refused - self._num_refused} {text}; {num_refused} so far")
        self.num_lost, self._num_refused = num_lost, num_refused
        return texts
