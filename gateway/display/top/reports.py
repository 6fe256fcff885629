"""What ``top --once`` and ``top --json`` print: everything that is known, once or every second."""

import time
from collections.abc import Callable, Sequence
from typing import Any, Final, TextIO

from gateway.client.transport import GatewaySubscriber, silence_text
from gateway.display.live.live_data import LiveData, LiveSource
from gateway.display.terminal.screen import Line, Style, encoded, line_text
from gateway.display.top.facts import source_facts
from gateway.display.top.pages import PAGES
from gateway.display.top.table import laid_out, sorted_by
from gateway.errors import QueryError
from gateway.logs.safe_text import safe_json
from gateway.messages.decode import json_text
from gateway.messages.host_time import now_utime
from gateway.outputs.discovery import DISCOVERY_S, missing_source

_PICTURE_S: Final = 2.5
"""How long after the first message a picture is complete: rates are over 2 s, statuses come every second."""

_UPDATE_S: Final = 0.1
_LINE_S: Final = 1.0


def wait_for_picture(live: LiveData, subscriber: GatewaySubscriber) -> list[LiveSource]:
    """Receive until the picture is complete; raises QueryError ("no-gateway") if nothing is heard."""
    start_s = time.monotonic()
    while True:
        sources = receive_once(live, subscriber)
        now_s = time.monotonic()
        first_s = live.first_heard_s
        if first_s is not None and now_s - first_s >= _PICTURE_S:
            return sources
        if first_s is None and now_s - start_s >= DISCOVERY_S:
            problem = silence_text(subscriber, live)
            if live.first_heard_s is None:
                raise QueryError(problem, code="no-gateway")


def missing_sources(sources: Sequence[LiveSource], wanted: Sequence[str]) -> list[QueryError]:
    """Return an error for each of the ``wanted`` sources that is not found."""
    found = [source.name for source in sources if source.heard_s is not None]
    return [
        QueryError(missing_source([name], found), code="no-gateway") for name in wanted if name not in found
    ]


def receive_once(live: LiveData, subscriber: GatewaySubscriber) -> list[LiveSource]:
    """Wait for a moment, and return the sources with what has come meanwhile."""
    time.sleep(_UPDATE_S)
    subscriber.tick()
    return live.update()


def print_tables(sources: Sequence[LiveSource], out: TextIO, width: int, *, is_coloured: bool) -> None:
    """Print every page, one below the other."""
    encoding = out.encoding or "ascii"
    for page in PAGES:
        table = page.table(sources)
        lines = laid_out(sorted_by(table, table.order), width, table.order)
        shown: list[Line] = [[(page.name, Style.MARKED)]]
        shown += (
            [lines.titles, *lines.body] if any(section.rows for section in table.sections) else lines.body
        )
        for line in [*shown, []]:
            text = line_text(line if is_coloured else _plain(line), width, has_colours=is_coloured)
            print(encoded(text.rstrip(), encoding).decode(encoding, "replace"), file=out)
    out.flush()


def _plain(line: Line) -> Line:
    return [(text, Style.PLAIN) for text, _ in line]


def json_line(live: LiveData, sources: Sequence[LiveSource]) -> str:
    """Return one JSON object, in one line, with everything about the sources."""
    facts: dict[str, Any] = {
        "utime": now_utime(),
        "sources": [source_facts(source) for source in sources],
        "num_foreign": live.num_foreign,
        "num_beyond": live.num_beyond,
    }
    return safe_json(json_text(facts))


def print_json_lines(
    live: LiveData, subscriber: GatewaySubscriber, out: TextIO, warn: Callable[[str], None]
) -> None:
    """Print a JSON object every second until an interrupt; ``warn`` once if nothing is heard."""
    start_s = next_s = time.monotonic()
    has_warned = False
    while True:
        sources = receive_once(live, subscriber)
        now_s = time.monotonic()
        if now_s - next_s >= _LINE_S:
            next_s += _LINE_S * ((now_s - next_s) // _LINE_S)
            print(json_line(live, sources), file=out, flush=True)
        if not has_warned and live.first_heard_s is None and now_s - start_s >= DISCOVERY_S:
            has_warned = True
            warn(silence_text(subscriber, live))
