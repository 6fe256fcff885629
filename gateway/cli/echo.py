"""``rtc3d-gateway echo``: subscribe to a gateway and print its messages."""

import queue
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, TextIO

import typer

from gateway.cli.message_lines import json_line, text_line
from gateway.cli.options import ConnectOption, PrefixOption, SourceOption, UrlOption
from gateway.cli.subscribers import (
    QUEUE_MESSAGES,
    LcmListener,
    ZenohListener,
    channel_pattern,
    key_pattern,
    open_zenoh,
)
from gateway.config.settings import effective_lcm_url
from gateway.outputs.lcm.output import open_lcm

Messages = queue.Queue[tuple[str, bytes]]
"""Messages, each with its Zenoh key or LCM channel."""


def echo(
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Subscribe on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Subscribe on LCM.")] = False,
    source: SourceOption = None,
    component: Annotated[
        str | None,
        typer.Option(help="Only 3d, 6d, analog, force, event, status, clock, parameters or c3d."),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this number of messages.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after this time.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
    connect: ConnectOption = None,
    url: UrlOption = None,
    prefix: PrefixOption = None,
) -> None:
    """Print what gateways publish. Exit status 1 if fewer than --count messages arrive in --seconds."""
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    if lcm:
        subscription = subscribe_lcm(prefix or "MOCAP", source, component, effective_lcm_url(url))
    else:
        subscription = subscribe_zenoh(prefix or "mocap", source, component, connect)
    with subscription as messages:
        try:
            printed = print_messages(messages, sys.stdout, count=count, as_json=as_json, timeout_s=seconds)
        except KeyboardInterrupt:
            return
    if count is not None and printed < count:
        print(f"{printed} of {count} messages arrived within {seconds:g} s", file=sys.stderr)
        raise typer.Exit(1)


@contextmanager
def subscribe_zenoh(
    prefix: str, source: str | None, component: str | None, connect: str | None
) -> Iterator[Messages]:
    """Provide a queue of messages from Zenoh; raises OutputError if no session opens."""
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
def subscribe_lcm(prefix: str, source: str | None, component: str | None, url: str) -> Iterator[Messages]:
    """Provide a queue of messages from LCM; raises OutputError if LCM does not open."""
    messages: Messages = queue.Queue(QUEUE_MESSAGES)
    pattern = channel_pattern(prefix, source, component)
    listener = LcmListener(open_lcm(url), pattern, lambda *event: _put(messages, *event))
    try:
        yield messages
    finally:
        listener.close()


def _put(messages: Messages, name: str, message: bytes) -> None:
    # When the terminal is slower than the stream, messages are lost here; the printed sequence shows it.
    with suppress(queue.Full):
        messages.put_nowait((name, message))


def print_messages(
    messages: Messages, out: TextIO, *, count: int | None, as_json: bool, timeout_s: float | None = None
) -> int:
    """Print ``count`` messages, one per line, and return how many were printed.

    Stops earlier when ``timeout_s`` has passed. ``count`` None means no limit.
    """
    printed = 0
    deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
    line = json_line if as_json else text_line
    while count is None or printed < count:
        try:
            wait_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            name, message = messages.get(timeout=wait_s)
        except queue.Empty:
            break
        print(line(name, message), file=out, flush=True)
        printed += 1
    return printed
