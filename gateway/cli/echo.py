"""``rtc3d-gateway echo``: subscribe to a gateway and print its messages."""

import queue
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated, Final, TextIO

import typer

from gateway.cli.options import (
    ComponentOption,
    ConnectOption,
    PrefixOption,
    SourceOption,
    UrlOption,
    ZenohConfigOption,
)

if TYPE_CHECKING:
    from gateway.outputs.kind import SubscriptionRequest

QUEUE_MESSAGES: Final = 10_000
"""How many messages may wait to be printed."""

Messages = queue.Queue[tuple[str, bytes]]
"""Messages, each with its Zenoh key or LCM channel."""


def _output_names() -> str:
    from gateway.outputs.registry import OUTPUTS

    return ", ".join(name for name, kind in OUTPUTS.items() if kind.subscribe is not None)


def echo(
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Subscribe on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Subscribe on LCM.")] = False,
    output: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Subscribe on the output with this name, such as zenoh or lcm."),
    ] = None,
    source: SourceOption = None,
    component: ComponentOption = None,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this number of messages.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after this many seconds.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    prefix: PrefixOption = None,
) -> None:
    """Print what gateways publish. Exit status 1 if fewer than --count messages arrive in --seconds."""
    if sum((zenoh, lcm, output is not None)) > 1:
        raise typer.BadParameter("give only one of --zenoh, --lcm and --output")
    name = output or ("lcm" if lcm else "zenoh")
    if zenoh_config is not None and name != "zenoh":
        raise typer.BadParameter("--zenoh-config is for subscribing on Zenoh")
    from gateway.outputs.kind import SubscriptionRequest

    request = SubscriptionRequest(source, component, prefix, connect or url, zenoh_config)
    with subscribed(name, request) as messages:
        try:
            printed = print_messages(messages, sys.stdout, count=count, as_json=as_json, timeout_s=seconds)
        except KeyboardInterrupt:
            return
    if count is not None and printed < count:
        print(f"{printed} of {count} messages arrived within {seconds:g} s", file=sys.stderr)
        raise typer.Exit(1)


@contextmanager
def subscribed(output: str, request: "SubscriptionRequest") -> Iterator[Messages]:
    """Provide a queue of the messages of an output; raises OutputError if it does not open."""
    from gateway.outputs.registry import OUTPUTS

    subscribe = OUTPUTS[output].subscribe if output in OUTPUTS else None
    if subscribe is None:
        raise typer.BadParameter(
            f"no messages to print from output {output!r}; choose one of: {_output_names()}"
        )
    messages: Messages = queue.Queue(QUEUE_MESSAGES)
    subscription = subscribe(request, lambda *message: _put(messages, *message))
    try:
        yield messages
    finally:
        subscription.close()


def _put(messages: Messages, name: str, message: bytes) -> None:
    # If printing is slower than the stream, messages are dropped; the gap in the printed sequence shows it.
    with suppress(queue.Full):
        messages.put_nowait((name, message))


def print_messages(
    messages: Messages, out: TextIO, *, count: int | None, as_json: bool, timeout_s: float | None = None
) -> int:
    """Print ``count`` messages, one per line, and return how many were printed.

    Stops earlier when ``timeout_s`` has passed. ``count`` None means no limit.
    """
    from gateway.cli.message_lines import json_line, text_line

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
