"""``rtc3d-gateway list``: the gateways and sources that can be heard, as a table, lines or JSON."""

import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from gateway.cli.options import AddressOptions, SourceOption, with_options
from gateway.logs.safe_text import safe_json
from gateway.messages.source_report import Level, SourceReport, StreamReport

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from gateway.client.transport import FoundSources


@with_options
def list_gateways(
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Look on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Listen on LCM.")] = False,
    source: SourceOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    where: AddressOptions,
) -> None:
    """List the gateways and sources that can be heard: states, rates, servers, hosts, versions.

    Exit status 3: no gateway found.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    where.check(lcm=lcm)

    from rich.console import Console

    from gateway.cli.main import exit_with
    from gateway.client.client import GatewayClient
    from gateway.errors import QueryError

    with GatewayClient(where.address(lcm=lcm)) as client:
        found = client.sources(source)
    if as_json:
        print(sources_json(found))
    elif found.sources:
        write_sources(found, Console())
    for note in notes(found):
        print(f"note: {note}", file=sys.stderr)
    exit_with([QueryError(found.absence, code="no-gateway")] if found.absence else [])


_COLOURS: Final = {Level.GOOD: "green", Level.WAITING: "yellow", Level.BAD: "red"}
_NARROW: Final = range(80, 110)
_NARROW_WIDTHS: Final = {"state": len("streaming 2000.0 Hz"), "components": len("analog force")}
"""The widths of these columns on a terminal of so many columns, so that the others stay in one line."""


def write_sources(found: "FoundSources", console: "Console") -> None:
    """Write a table on a terminal; otherwise, a line for each source with tabs between the columns."""
    from gateway.display.terminal import write_records

    if console.is_terminal:
        console.print(_table(found.sources, is_narrow=console.width in _NARROW))
        return
    write_records(console.file, [_record(source) for source in found.sources])


def sources_json(found: "FoundSources") -> str:
    """Return the JSON object that docs/reference/commands.md describes."""
    content = {
        "sources": [_source_json(source) for source in found.sources],
        "num_left_out": found.num_left_out,
    }
    return safe_json(json.dumps(content, indent=2, ensure_ascii=False))


def notes(found: "FoundSources") -> list[str]:
    """Return sentences about what the list does not show, and about sources that disturb each other."""
    texts = [
        f"{number} gateways serve a source {name!r}, and their messages mix; rename one, or change a prefix"
        for name, number in sorted(Counter(source.name for source in found.sources).items())
        if number > 1
    ]
    if found.num_left_out:
        texts.append(
            f"{found.num_left_out} more sources or statuses were left out, because there are too many"
        )
    return texts


def _table(sources: Sequence[SourceReport], *, is_narrow: bool) -> "Table":
    from rich.text import Text

    from gateway.display.terminal import list_table

    table = list_table()
    for heading in ("source", "state", "components", "server", "host", "version"):
        width = _NARROW_WIDTHS.get(heading) if is_narrow else None
        table.add_column(heading, overflow="fold", width=width)
    for source in sources:
        rows = [(_state(stream), stream.components) for stream in source.streams]
        if source.problem or not rows:
            rows.append((Text(source.problem or "no streams", "red"), ""))
        for number, (state, components) in enumerate(rows):
            others = (source.server, source.host, source.version) if number == 0 else ("", "", "")
            table.add_row(
                Text(source.name if number == 0 else "", "bold"), state, *map(Text, (components, *others))
            )
    return table


def _state(stream: StreamReport) -> "Text":
    from rich.text import Text

    return Text(stream.text, _COLOURS[stream.level])


def _record(source: SourceReport) -> tuple[str, ...]:
    components = ", ".join(stream.components for stream in source.streams)
    texts = ", ".join(filter(None, (source.text, source.problem)))
    return source.name, texts, components, source.server, source.host, source.version


def _source_json(source: SourceReport) -> dict[str, Any]:
    return {
        "source": source.name,
        "gateway": source.gateway or None,
        "problem": source.problem,
        "server": source.server or None,
        "host": source.host or None,
        "version": source.version or None,
        "streams": [_stream_json(stream) for stream in source.streams],
    }


def _stream_json(stream: StreamReport) -> dict[str, Any]:
    return {
        "components": stream.components.split(),
        "text": stream.text,
        "state": stream.state,
        "problem": stream.problem,
        "rate_hz": round(stream.frame_rate_hz, 3) if math.isfinite(stream.frame_rate_hz) else None,
        "tries": stream.tries,
    }
