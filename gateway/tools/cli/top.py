"""``rtc3d-gateway top``: what gateways publish, as tables that change."""

import contextlib
import logging
import os
import shutil
import signal
import sys
from collections import deque
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gateway.errors import QueryError
from gateway.runtime.log_format import LogLevel, set_up_log
from gateway.runtime.safe_text import safe_lines, safe_text
from gateway.tools.cli import options
from gateway.tools.cli.main import exit_with

if TYPE_CHECKING:
    from gateway.client.transport import GatewaySubscriber
    from gateway.tools.display.live import LiveData

_MAX_TITLE: Final = 60
_MAX_WIDTH: Final = 10_000
"""How wide tables may be in files and pipes."""


@options.with_options
def top(
    *,
    source: options.SourcesOption = None,
    once: Annotated[
        bool, typer.Option("--once", help="Print all tables once, as without a terminal, and end.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print one JSON object per second, until Ctrl-C; with --once, only one object."
        ),
    ] = False,
    complete: Annotated[
        bool,
        typer.Option(
            "--complete", help="Fill gaps from the gateway's history; show what was refilled and stays lost."
        ),
    ] = False,
    lcm: options.LcmOption = False,
    where: options.AddressOptions,
) -> None:
    """Watch what gateways publish: rates, gaps, latencies, visibility, clocks, drops, outputs, queries.

    With --once, exit status 3 if no gateway is found, or none that serves a source.
    """
    where.check(lcm=lcm)
    from gateway.client.client import GatewayClient
    from gateway.client.transport import close_in_time
    from gateway.tools.display.live import LiveData

    wanted = list(dict.fromkeys(source or ()))
    is_shown = not (once or as_json) and _has_screen()
    notices: deque[str] = deque(maxlen=1)
    if is_shown:
        logging.basicConfig(level=logging.WARNING, handlers=[_Notices(notices)])
    else:
        set_up_log(LogLevel.WARNING)
    live = LiveData()
    subscriber = GatewayClient(where.address(lcm=lcm)).subscribe(wanted, None, live, complete=complete)
    try:
        if is_shown:
            words = ("LCM", where.url) if lcm else ("Zenoh", where.connect)
            title = safe_text(" ".join(filter(None, words)), _MAX_TITLE)
            _show(live, subscriber, notices, title)
        elif as_json and not once:
            from gateway.tools.display.top.app import print_json_lines

            with contextlib.suppress(KeyboardInterrupt):
                print_json_lines(
                    live, subscriber, sys.stdout, lambda text: print(safe_lines(text), file=sys.stderr)
                )
        else:
            _print_once(live, subscriber, wanted, as_json=as_json)
    finally:
        close_in_time(subscriber)


def _has_screen() -> bool:
    """Return whether stdout is a terminal on which texts can be placed."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in {"", "dumb", "unknown"}


class _Notices(logging.Handler):
    """Keeps what is logged: it must not be written into the tables."""

    def __init__(self, notices: "deque[str]") -> None:
        super().__init__()
        self._notices = notices

    def emit(self, record: logging.LogRecord) -> None:
        self._notices.append(record.getMessage())


def _show(live: "LiveData", subscriber: "GatewaySubscriber", notices: "deque[str]", title: str) -> None:
    from gateway.tools.display.terminal import Keyboard, Screen
    from gateway.tools.display.top.app import App

    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # ignored by nohup
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    screen = Screen(sys.stdout.fileno(), sys.stdout.encoding)
    with contextlib.suppress(KeyboardInterrupt):
        App(live, subscriber, screen, Keyboard.of_stdin(), notices, title).run()


def _print_once(
    live: "LiveData", subscriber: "GatewaySubscriber", wanted: list[str], *, as_json: bool
) -> None:
    from gateway.tools.display.terminal import has_colours
    from gateway.tools.display.top.app import json_line, missing_sources, print_tables, wait_for_picture

    try:
        sources = wait_for_picture(live, subscriber)
    except QueryError as error:
        exit_with([error])
        return
    if as_json:
        print(json_line(live, sources), flush=True)
    else:
        size = shutil.get_terminal_size() if sys.stdout.isatty() else None
        is_coloured = size is not None and _has_screen() and has_colours(os.environ)
        width = _MAX_WIDTH if size is None else size.columns
        print_tables(sources, sys.stdout, width, is_coloured=is_coloured)
    exit_with(missing_sources(sources, wanted))
