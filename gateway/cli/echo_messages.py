"""Printing the messages of ``echo``, one per line."""

import json
import queue
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any, Final, TextIO

from gateway.cli.echo_sources import Silence, Units
from gateway.errors import ProtocolError
from gateway.logs.safe_text import safe_json, safe_text
from gateway.messages.decode import decode, to_json
from gateway.messages.summary import summarise, summarise_xml
from gateway.outputs.kind import Receive, Subscription, SubscriptionRequest

_MAX_LINE_CHARACTERS: Final = 4000


def json_line(name: str, message: bytes) -> str:
    """Return a JSON object: the fields of the message, and ``name`` (the key or channel) as ``key``."""
    try:
        fields = to_json(decode(message))
    except ProtocolError as error:
        match _xml_or_json(message):
            case bytes() as xml:
                fields = {"xml": xml.decode("utf-8", "replace")}
            case dict() as json_object:
                fields = json_object
            case _:
                fields = {"error": str(error)}
    return safe_json(json.dumps({"key": name} | fields))


def text_line(name: str, message: bytes, units_of: Callable[[str, Any], Sequence[str]]) -> str:
    """Return a line of text: ``name`` (the key or channel) and a summary of the message.

    ``units_of`` returns the units of the items of a decoded message with this name.
    """
    try:
        decoded = decode(message)
        line = f"{name} {summarise(decoded, units_of(name, decoded))}"
    except ProtocolError as error:
        match _xml_or_json(message):
            case bytes() as xml:
                line = f"{name} {summarise_xml(xml)}"
            case dict() as json_object:
                line = f"{name} " + ", ".join(f"{key} {value}" for key, value in json_object.items())
            case _:
                line = f"{name}: {error}"
    return safe_text(line, _MAX_LINE_CHARACTERS)


def _xml_or_json(message: bytes) -> bytes | dict[str, Any] | None:
    """Return XML unchanged, or the object in a JSON text (both exist on Zenoh); None for other bytes."""
    if message.lstrip().startswith(b"<"):
        return message
    try:
        value = json.loads(message)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


MAX_WAITING: Final = 10_000
"""How many messages may wait to be printed."""

POLL_S: Final = 0.1
"""How often the silence is checked before the first message."""

Subscribe = Callable[[SubscriptionRequest, Receive], Subscription]


class Limits:
    """When ``echo`` ends: after ``count`` messages, or after ``seconds``. None means no limit."""

    def __init__(self, count: int | None, seconds: float | None) -> None:
        self.count = count
        self._end_s = None if seconds is None else time.monotonic() + seconds

    def wait_s(self, longest_s: float | None) -> float | None:
        """Return how long to wait for messages: to the end, but not longer than ``longest_s``."""
        if self._end_s is None:
            return longest_s
        left_s = max(0.0, self._end_s - time.monotonic())
        return left_s if longest_s is None else min(left_s, longest_s)

    @property
    def is_over(self) -> bool:
        """Whether the time is up."""
        return self._end_s is not None and time.monotonic() >= self._end_s


class WaitingMessages:
    """The messages that wait to be printed, each with its key or channel, up to ``max_waiting``."""

    def __init__(self, max_waiting: int = MAX_WAITING) -> None:
        self._messages: queue.Queue[tuple[str, bytes]] = queue.Queue(max_waiting)
        self.num_dropped = 0
        """How many messages came while too many were waiting."""

    def put(self, name: str, message: bytes) -> None:
        """Take a message, in the thread that receives."""
        try:
            self._messages.put_nowait((name, message))
        except queue.Full:
            self.num_dropped += 1

    def get(self, timeout_s: float | None) -> tuple[str, bytes] | None:
        """Return the next message; None if there is none in time."""
        try:
            return self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None


def print_messages(
    subscribe: Subscribe,
    request: SubscriptionRequest,
    limits: Limits,
    silence: Silence,
    units: Units,
    out: TextIO,
    *,
    as_json: bool,
) -> int:
    """Print messages until ``limits`` are reached, and return how many were printed.

    Raises OutputError if the output does not open, QueryError if there cannot be any messages.
    """
    messages = WaitingMessages()
    line = json_line if as_json else partial(text_line, units_of=units.of)
    num_printed = 0
    try:
        with closing(subscribe(request, messages.put)):
            while limits.count is None or num_printed < limits.count:
                received = messages.get(limits.wait_s(None if num_printed else POLL_S))
                if received is not None:
                    print(line(*received), file=out, flush=True)
                    num_printed += 1
                elif limits.is_over:
                    break
                else:
                    silence.check()
    finally:
        _report_dropped(messages.num_dropped)
    return num_printed


def _report_dropped(num_dropped: int) -> None:
    if num_dropped:
        print(
            f"{num_dropped} messages were not printed, because they came faster than they can be printed; "
            "choose fewer with --source or --component, or count them with --hz",
            file=sys.stderr,
        )
