"""``rtc3d-gateway echo``: subscribe and print."""

import json
import queue
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from gateway.cli.subscribers import (
    QUEUE_MESSAGES,
    LcmListener,
    ZenohListener,
    channel_pattern,
    key_pattern,
    open_zenoh,
)
from gateway.errors import ProtocolError
from gateway.messages.decode import decode, one_line, to_json, xml_text
from gateway.outputs.lcm.output import open_lcm

Messages = queue.Queue[tuple[str, bytes]]
"""Keys or channels with their messages."""


def _put(messages: Messages, name: str, message: bytes) -> None:
    # A terminal slower than the stream loses messages here; the sequence numbers printed show it.
    with suppress(queue.Full):
        messages.put_nowait((name, message))


@contextmanager
def zenoh_messages(
    prefix: str, source: str | None, component: str | None, connect: str | None
) -> Iterator[Messages]:
    """Give the queue of what comes on Zenoh; raises OutputError if no session opens."""
    messages: Messages = queue.Queue(QUEUE_MESSAGES)
    session = open_zenoh(connect)
    try:
        ZenohListener(
            session, key_pattern(prefix, source, component), lambda *sample: _put(messages, *sample)
        )
        yield messages
    finally:
        session.close()


@contextmanager
def lcm_messages(prefix: str, source: str | None, component: str | None, url: str) -> Iterator[Messages]:
    """Give the queue of what comes on LCM; raises OutputError if LCM does not open."""
    messages: Messages = queue.Queue(QUEUE_MESSAGES)
    pattern = channel_pattern(prefix, source, component)
    listener = LcmListener(open_lcm(url), pattern, lambda *event: _put(messages, *event))
    try:
        yield messages
    finally:
        listener.close()


def echo(
    messages: Messages, out: TextIO, *, count: int | None, as_json: bool, timeout_s: float | None = None
) -> int:
    """Print messages until ``count`` of them or, if given, ``timeout_s``; return how many were printed.

    Text is one line a message for reading; JSON is one object a line, the message's fields and ``key``.
    """
    printed = 0
    deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
    while count is None or printed < count:
        try:
            wait_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            name, message = messages.get(timeout=wait_s)
        except queue.Empty:
            break
        line = _json_line(name, message) if as_json else _text_line(name, message)
        print(line, file=out, flush=True)
        printed += 1
    return printed


def _json_line(name: str, message: bytes) -> str:
    try:
        fields = to_json(decode(message))
    except ProtocolError as error:
        match _without_type(message):
            case bytes() as xml:
                fields = {"xml": xml.decode("utf-8", "replace")}
            case dict() as announcement:
                fields = announcement
            case _:
                fields = {"error": str(error)}
    return json.dumps({"key": name} | fields)


def _text_line(name: str, message: bytes) -> str:
    try:
        line = f"{name} {one_line(decode(message))}"
    except ProtocolError as error:
        match _without_type(message):
            case bytes() as xml:
                line = f"{name} {xml_text(xml)}"
            case dict() as announcement:
                line = f"{name} " + ", ".join(f"{key} {value}" for key, value in announcement.items())
            case _:
                line = f"{name}: {error}"
    # Texts of servers and of strangers: none may steer the terminal.
    return "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line
    )


def _without_type(message: bytes) -> bytes | dict[str, Any] | None:
    """Return what Zenoh carries besides LCM messages: a server's XML, or the object of a JSON text."""
    if message.lstrip().startswith(b"<"):
        return message
    try:
        value = json.loads(message)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
