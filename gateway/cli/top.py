"""``rtc3d-gateway top``: what gateways publish, as tables that change."""

import contextlib
import logging
import os
import shutil
import signal
import sys
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Final, TextIO

import typer

from gateway.cli.main import exit_with
from gateway.cli.options import AddressOptions, SourcesOption, with_options
from gateway.errors import QueryError
from gateway.logs.log_format import LogLevel, set_up_log
from gateway.logs.safe_text import safe_lines, safe_text

if TYPE_CHECKING:
    from gateway.client.client import GatewayAddress
    from gateway.client.transport import GatewaySubscriber
    from gateway.display.live import LiveData

_MAX_TITLE: Final = 60
_MAX_WIDTH: Final = 10_000
"""How wide tables may be in files and pipes."""


@with_options
def top(
    *,
    source: SourcesOption = None,
    once: Annotated[
        bool, typer.Option("--once", help="Print all tables once, as without a terminal, and end.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print one JSON object per second, until Ctrl-C; with --once, only one object."
        ),
    ] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Receive on LCM; the default is Zenoh.")] = False,
    where: AddressOptions,
) -> None:
    """Watch what gateways publish: rates, gaps, latencies, visibility, clocks, drops, outputs, queries.

    With --once, exit status 3 if no gateway is found, or none that serves a source.
    """
    where.check(lcm=lcm)
    _run(where.address(lcm=lcm), list(dict.fromkeys(source or ())), is_once=once, as_json=as_json)


def _run(address: "GatewayAddress", wanted: list[str], *, is_once: bool, as_json: bool) -> None:
    from gateway.client.client import GatewayClient
    from gateway.client.transport import close_in_time
    from gateway.display.live import LiveData

    is_shown = not (is_once or as_json) and has_screen(sys.stdout, os.environ)
    notices: deque[str] = deque(maxlen=1)
    if is_shown:
        logging.basicConfig(level=logging.WARNING, handlers=[_Notices(notices)])
    else:
        set_up_log(LogLevel.WARNING)
    live = LiveData()
    subscriber = GatewayClient(address).subscribe(wanted, None, live)
    try:
        if is_shown:
            _show(live, subscriber, notices, _title(address))
        else:
            _print(live, subscriber, wanted, is_once=is_once or not as_json, as_json=as_json)
    finally:
        close_in_time(subscriber)


def has_screen(out: TextIO, environ: Mapping[str, str]) -> bool:
    """Return whether ``out`` is a terminal on which texts can be placed."""
    return out.isatty() and environ.get("TERM", "dumb") not in {"", "dumb", "unknown"}


def _title(address: "GatewayAddress") -> str:
    words = ("LCM", address.url) if address.is_lcm else ("Zenoh", address.connect)
    return safe_text(" ".join(filter(None, words)), _MAX_TITLE)


class _Notices(logging.Handler):
    """Keeps what is logged: it must not be written into the tables."""

    def __init__(self, notices: "deque[str]") -> None:
        super().__init__()
        self._notices = notices

    def emit(self, record: logging.LogRecord) -> None:
        self._notices.append(record.getMessage())


def _show(live: "LiveData", subscriber: "GatewaySubscriber", notices: "deque[str]", title: str) -> None:
    from gateway.display.terminal import Keyboard, Screen
    from gateway.display.top.app import App

    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # ignored by nohup
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    screen = Screen(sys.stdout.fileno(), sys.stdout.encoding)
    with contextlib.suppress(KeyboardInterrupt):
        App(live, subscriber, screen, Keyboard.of_stdin(), notices, title).run()


def _print(
    live: "LiveData", subscriber: "GatewaySubscriber", wanted: list[str], *, is_once: bool, as_json: bool
) -> None:
    from gateway.display.terminal import has_colours
    from gateway.display.top.app import (
        json_line,
        missing_sources,
        print_json_lines,
        print_tables,
        wait_for_picture,
    )

    if not is_once:
        with contextlib.suppress(KeyboardInterrupt):
            print_json_lines(
                live, subscriber, sys.stdout, lambda text: print(safe_lines(text), file=sys.stderr)
            )
        return
    try:
        sources = wait_for_picture(live, subscriber)
    except QueryError as error:
        exit_with([error])
        return
    if as_json:
        print(json_line(live, sources), flush=True)
    else:
        size = shutil.get_terminal_size() if sys.stdout.isatty() else None
        is_coloured = size is not None and has_screen(sys.stdout, os.environ) and has_colours(os.environ)
        width = _MAX_WIDTH if size is None else size.columns
        print_tables(sources, sys.stdout, width, is_coloured=is_coloured)
    exit_with(missing_sources(sources, wanted))
