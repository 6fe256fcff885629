"""What ``record`` shows while it runs: a line with the progress, and whatever goes wrong."""

import contextlib
import sys
import time
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gateway.recorder.series import RecordedSource
from gateway.recorder.take_recording import TakeRecording
from gateway.safe_text import safe_text
from gateway.subscriber.subscribe import GatewaySubscriber

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
        self._start_s = self._rate_s = time.monotonic()
        self._checked_s = self._start_s
        self._shown_s = self._start_s
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
            self._shown_s = now_s
            self._show(now_s)

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

    # The disk, and losses.

    def _check_disk(self) -> None:
        sink = self._recording.sink
        problem = "" if sink is None else sink.problem
        if problem != self._disk_problem:
            self._disk_problem = problem
            if problem:
                self._print(f"{problem}; up to 64 MB wait in memory until the disk has room again")
            else:
                self._print("the disk accepts what is written again")
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

    # Silence.

    def _check_silence(self, now_s: float) -> None:
        sources = [source for source in self._recording.sources_now if source.heard_s is not None]
        missing = set(self._wanted) - {source.name for source in sources}
        if now_s - self._start_s >= SILENCE_S and (missing or not sources):
            self._report_missing()
        for source in sources:
            assert source.heard_s is not None  # noqa: S101 - see above
            text = f"{source.name}: nothing has arrived for 2 s; is its gateway running?"
            if now_s - source.heard_s >= SILENCE_S:
                self._report(text)
            else:
                self._reported.discard(text)
                self._check_streams(source, now_s)

    def _report_missing(self) -> None:
        if "missing" not in self._reported:
            problem = self._subscriber.silence()
            if problem:
                self._reported.add("missing")
                self._print(problem)

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

    # The line.

    def _show(self, now_s: float) -> None:
        line = self._line(now_s)
        if self._live is None:
            self._print(line)
        else:
            self._live.update(Text(safe_text(line), no_wrap=True, overflow="ellipsis"), refresh=True)

    def _line(self, now_s: float) -> str:
        recording = self._recording
        counts = (recording.num_messages, recording.num_bytes)
        elapsed_s = max(now_s - self._rate_s, 1e-3)
        message_rate, byte_rate = (
            (new - old) / elapsed_s for new, old in zip(counts, self._former, strict=True)
        )
        self._former, self._rate_s = counts, now_s
        minutes, seconds = divmod(int(now_s - self._start_s), 60)
        sink = recording.sink
        parts = [
            f"{minutes}:{seconds:02}",
            "waiting for messages" if sink is None else size_text(sink.num_bytes),
            f"{message_rate:.0f} messages/s",
            f"{size_text(byte_rate)}/s",
            f"{self._num_lost} lost" if self._num_lost else "no gaps",
            f"{size_text(recording.queued_bytes)} to be written",
        ]
        return "  ".join(parts)


def size_text(num_bytes: float) -> str:
    """Return a size in decimal units: "12.3 MB"."""
    if num_bytes < 1e6:
        return f"{num_bytes / 1e3:.0f} kB"
    return f"{num_bytes / 1e6:.1f} MB" if num_bytes < 1e9 else f"{num_bytes / 1e9:.2f} GB"
