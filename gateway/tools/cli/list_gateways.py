"""``rtc3d-gateway list``: the gateways and sources that can be heard, as a table, lines or JSON."""

import math
import sys
from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from gateway.errors import QueryError
from gateway.messages.source_report import Level, SourceReport
from gateway.tools.cli import options
from gateway.tools.cli.main import exit_with, print_json

if TYPE_CHECKING:
    from rich.console import Console

    from gateway.client.transport import FoundSources


@options.with_options
def list_gateways(
    *,
    zenoh: options.ZenohOption = False,
    lcm: options.LcmOption = False,
    source: options.SourceOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    where: options.AddressOptions,
) -> None:
    """List the gateways and sources that can be heard: states, rates, servers, hosts, versions.

    Exit status 3: no gateway found.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    where.check(lcm=lcm)

    from rich.console import Console

    from gateway.client.client import GatewayClient

    with GatewayClient(where.address(lcm=lcm)) as client:
        found = client.sources(source)
    if as_json:
        print_json(found_json(found))
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
    from rich.text import Text

    from gateway.tools.display.terminal import list_table, write_records

    if not console.is_terminal:
        for source in found.sources:
            components = ", ".join(stream.components for stream in source.streams)
            texts = ", ".join(filter(None, (source.text, source.problem)))
            record = (
                source.name,
                texts,
                components,
                source.server,
                source.host,
                source.version,
                _via(source),
            )
            write_records(console.file, [record])
        return
    table = list_table()
    has_routers = any(source.routers for source in found.sources)
    headings = ("source", "state", "components", "server", "host", "version", "routers")
    for heading in headings if has_routers else headings[:-1]:
        width = _NARROW_WIDTHS.get(heading) if console.width in _NARROW else None
        table.add_column(heading, overflow="fold", width=width)
    for source in found.sources:
        rows = [(Text(each.text, _COLOURS[each.level]), each.components) for each in source.streams]
        if source.problem or not rows:
            rows.append((Text(source.problem or "no streams", "red"), ""))
        name, others = source.name, [source.server, source.host, source.version]
        others += [_via(source)] if has_routers else []
        for state, components in rows:
            table.add_row(Text(name, "bold"), state, *map(Text, (components, *others)))
            name, others = "", [""] * len(others)
    console.print(table)


def _via(source: SourceReport) -> str:
    """Return the routers between the gateway and this computer, in the direction of the data."""
    return " → ".join(source.routers or ())


def found_json(found: "FoundSources") -> dict[str, Any]:
    """Return the JSON object that docs/reference/command-json.md describes."""
    sources = [
        {
            "source": source.name,
            "gateway": source.gateway or None,
            "problem": source.problem,
            "server": source.server or None,
            "host": source.host or None,
            "version": source.version or None,
            "routers": None if source.routers is None else [*source.routers],
            "streams": [
                {
                    "components": stream.components.split(),
                    "text": stream.text,
                    "state": stream.state,
                    "problem": stream.problem,
                    "rate_hz": round(stream.frame_rate_hz, 3)
                    if math.isfinite(stream.frame_rate_hz)
                    else None,
                    "tries": stream.tries,
                }
                for stream in source.streams
            ],
        }
        for source in found.sources
    ]
    return {"sources": sources, "num_left_out": found.num_left_out}


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
