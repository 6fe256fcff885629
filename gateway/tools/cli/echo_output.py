"""What ``echo`` prints: the messages, one per line, or with ``--hz`` the rate of each key or channel."""

import contextlib
import json
import math
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any, Final, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, to_json
from gateway.messages.host_time import now_utime
from gateway.messages.summary import summarise, summarise_xml
from gateway.outputs.kind import Receive, Subscription
from gateway.runtime.safe_text import safe_json, safe_text
from gateway.tools.cli.echo_sources import EchoSources
from gateway.tools.display.terminal import list_table, write_records

_MAX_LINE_CHARACTERS: Final = 4000


def json_line(name: str, message: bytes) -> str:
    """Return a JSON object: the fields of the message, and ``name`` (the key or channel) as ``key``."""
    match _content(message):
        case ProtocolError() as error:
            fields: dict[str, Any] = {"error": str(error)}
        case bytes() as xml:
            fields = {"xml": xml.decode("utf-8", "replace")}
        case dict() as json_object:
            fields = json_object
        case decoded:
            fields = to_json(decoded)
    return safe_json(json.dumps({"key": name} | fields))


def text_line(name: str, message: bytes, units_of: Callable[[str, Any], Sequence[str]]) -> str:
    """Return a line of text: ``name`` (the key or channel) and a summary of the message.

    ``units_of`` returns the units of the items of a decoded message with this name.
    """
    match _content(message):
        case ProtocolError() as error:
            line = f"{name}: {error}"
        case bytes() as xml:
            line = f"{name} {summarise_xml(xml)}"
        case dict() as json_object:
            line = f"{name} " + ", ".join(f"{key} {value}" for key, value in json_object.items())
        case decoded:
            line = f"{name} {summarise(decoded, units_of(name, decoded))}"
    return safe_text(line, _MAX_LINE_CHARACTERS)


def _content(message: bytes) -> Any:
    """Return the decoded message; XML unchanged; the object in a JSON text; or why it is none of these."""
    try:
        return decode(message)
    except ProtocolError as error:
        if message.lstrip().startswith(b"<"):  # XML and JSON exist on Zenoh
            return message
        try:
            value = json.loads(message)
        except (ValueError, RecursionError):
            return error
        return value if isinstance(value, dict) else error


MAX_WAITING: Final = 10_000
"""How many messages may wait to be printed."""

_POLL_S: Final = 0.1
"""How often the time is checked, and the silence before the first message."""

Subscribe = Callable[[Receive], Subscription]


def print_messages(
    subscribe: Subscribe,
    sources: EchoSources,
    out: TextIO,
    *,
    count: int | None,
    seconds: float | None,
    as_json: bool,
) -> int:
    """Print ``count`` messages, or those of ``seconds``, and return how many they are. None means no limit.

    Raises OutputError if the output does not open, QueryError if there cannot be any messages.
    """
    line = json_line if as_json else partial(text_line, units_of=sources.units_of)
    waiting: queue.Queue[tuple[str, bytes]] = queue.Queue(MAX_WAITING)
    num_dropped = num_printed = 0
    end_s = time.monotonic() + (math.inf if seconds is None else seconds)

    def receive(name: str, message: bytes) -> None:
        nonlocal num_dropped
        try:
            waiting.put_nowait((name, message))
        except queue.Full:
            num_dropped += 1

    try:
        with closing(subscribe(receive)):
            while count is None or num_printed < count:
                try:
                    received = waiting.get(timeout=_wait_s(end_s))
                except queue.Empty:
                    if time.monotonic() >= end_s:
                        break
                    if not num_printed:
                        sources.check_silence()
                    continue
                print(line(*received), file=out, flush=True)
                num_printed += 1
    finally:
        if num_dropped:
            print(too_fast_text(num_dropped), file=sys.stderr)
    return num_printed


def too_fast_text(num_dropped: int) -> str:
    """Return that so many messages were left out, and what to do."""
    return (
        f"{num_dropped} messages were not printed, because they came faster than they can be "
        "printed; choose fewer with --source or --component, or count them with --hz"
    )


WINDOW_S: Final = 10.0
MIN_WINDOW: Final = 10
"""The window: the messages of so many seconds, and at least so many messages."""

MAX_KEYS: Final = 1000
"""Names come from the network."""

_EACH_S: Final = 1.0
_STOPPED_S: Final = 2.0
"""A key has stopped if nothing came for so long, and for three of its usual intervals."""

_HEADINGS: Final = ("key", "rate", "min", "max", "std dev", "window")


class Rate(NamedTuple):
    """The rate of one key or channel.

    The shortest and the longest interval between two messages, and the standard deviation of the intervals,
    are those of the newest ``window`` messages; None if there is one only. ``age_s`` is the time since the
    newest one; ``has_stopped`` says that no more seem to come.
    """

    key: str
    rate_hz: float
    min_s: float | None
    max_s: float | None
    std_dev_s: float | None
    window: int
    age_s: float
    has_stopped: bool


class Rates:
    """Counts messages in the thread that receives them, until ``max_messages`` have come (None: no limit)."""

    def __init__(
        self, max_messages: int | None = None, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._max_messages = max_messages
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._arrivals: dict[str, deque[float]] = {}
        self.is_complete = threading.Event()
        """Set when ``max_messages`` have come."""
        self.num_messages = 0
        self.num_beyond = 0
        """How many messages are in no row, because there are too many keys."""

    def receive(self, key: str, _message: bytes) -> None:
        """Note the arrival of a message."""
        now_s = self._monotonic()
        with self._lock:
            if self.is_complete.is_set():
                return
            self.num_messages += 1
            if self.num_messages == self._max_messages:
                self.is_complete.set()
            arrivals = self._arrivals.get(key)
            if arrivals is None:
                if len(self._arrivals) >= MAX_KEYS:
                    self.num_beyond += 1
                    return
                arrivals = self._arrivals[key] = deque()
            arrivals.append(now_s)
            while len(arrivals) > MIN_WINDOW and arrivals[0] < now_s - WINDOW_S:
                arrivals.popleft()

    def rows(self) -> list[Rate]:
        """Return the rates, sorted by key."""
        with self._lock:
            copies = {key: np.array(arrivals) for key, arrivals in self._arrivals.items()}
        now_s = self._monotonic()
        return [_rate(key, arrivals_s, now_s) for key, arrivals_s in sorted(copies.items())]


def _rate(key: str, arrivals_s: NDArray[np.float64], now_s: float) -> Rate:
    age_s = max(0.0, now_s - float(arrivals_s[-1]))
    if len(arrivals_s) == 1:
        return Rate(key, 0.0, None, None, None, 1, age_s, age_s > _STOPPED_S)
    intervals_s = np.diff(arrivals_s)
    mean_s = float(intervals_s.mean())
    has_stopped = age_s > max(_STOPPED_S, 3 * mean_s)
    # After a few messages at once, such as the first ones, the time since then counts, too.
    span_s = float(now_s - arrivals_s[0]) if age_s > 2 * mean_s else mean_s * len(intervals_s)
    rate_hz = 0.0 if has_stopped or span_s <= 0 else len(intervals_s) / span_s
    spread = (float(intervals_s.min()), float(intervals_s.max()), float(intervals_s.std()))
    return Rate(key, rate_hz, *spread, len(arrivals_s), age_s, has_stopped)


def _wait_s(end_s: float) -> float:
    return min(_POLL_S, max(0.0, end_s - time.monotonic()))


def print_rates(
    subscribe: Subscribe,
    sources: EchoSources,
    out: TextIO,
    *,
    count: int | None,
    seconds: float | None,
    as_json: bool,
) -> int:
    """Print the rates every second, with the limits of ``print_messages``; return how many messages came.

    On a terminal, the table is refreshed in place. Raises OutputError and QueryError as ``print_messages``.
    """
    rates = Rates(count)
    end_s = time.monotonic() + (math.inf if seconds is None else seconds)
    console = Console(file=out)
    live = None if as_json or not console.is_terminal else Live(console=console, auto_refresh=False)

    def show() -> None:
        if live is None:
            _print_rows(rates.rows(), out, as_json=as_json)
        else:
            live.update(_table(rates.rows()), refresh=True)

    with closing(subscribe(rates.receive)), live or contextlib.nullcontext():
        shown_s = time.monotonic()
        try:
            while not rates.is_complete.wait(_wait_s(end_s)):
                if time.monotonic() >= end_s:
                    break
                if not rates.num_messages:
                    sources.check_silence()
                elif time.monotonic() - shown_s >= _EACH_S:
                    shown_s = time.monotonic()
                    show()
        finally:
            if rates.num_messages:
                show()
            if rates.num_beyond:
                beyond = f"because there are more than {MAX_KEYS} keys"
                print(f"{rates.num_beyond} messages are in no row, {beyond}", file=sys.stderr)
    return rates.num_messages


def _print_rows(rows: Sequence[Rate], out: TextIO, *, as_json: bool) -> None:
    utime = now_utime()
    for row in rows:
        if as_json:
            fields = {
                name: round(value, 6) if isinstance(value, float) else value
                for name, value in row._asdict().items()
            }
            print(safe_json(json.dumps({"utime": utime} | fields, ensure_ascii=False)), file=out)
        else:
            write_records(out, [_cells(row)])
    out.flush()


def _table(rows: Sequence[Rate]) -> Table:
    table = list_table()
    table.add_column(_HEADINGS[0], overflow="fold")
    for heading in _HEADINGS[1:]:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        key, *cells = _cells(row)
        table.add_row(Text(key), *cells, style="yellow" if row.has_stopped else "")
    return table


def _cells(row: Rate) -> tuple[str, ...]:
    rate = f"none for {row.age_s:.0f} s" if row.has_stopped else f"{row.rate_hz:.1f} Hz"
    if row.window == 1 and not row.has_stopped:
        rate = "-"
    times = ("-" if time_s is None else f"{1e3 * time_s:.1f} ms" for time_s in row[2:5])
    return safe_text(row.key), rate, *times, str(row.window)
