"""The output of ``list``: a table on a terminal, a line for each source otherwise, or JSON."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.client.found_sources import FoundSources
from gateway.display.terminal.lists import list_table, write_records
from gateway.logs.safe_text import safe_json
from gateway.messages.source_report import Level, SourceReport, StreamReport

_COLOURS: Final = {Level.GOOD: "green", Level.WAITING: "yellow", Level.BAD: "red"}
_NARROW: Final = range(80, 110)
_NARROW_WIDTHS: Final = {"state": len("streaming 2000.0 Hz"), "components": len("analog force")}
"""The widths of these columns on a terminal of so many columns, so that the others stay in one line."""


def write_sources(found: FoundSources, console: Console) -> None:
    """Write a table on a terminal; otherwise, a line for each source with tabs between the columns."""
    if console.is_terminal:
        console.print(_table(found.sources, is_narrow=console.width in _NARROW))
        return
    write_records(console.file, [_record(source) for source in found.sources])


def sources_json(found: FoundSources) -> str:
    """Return the JSON object that docs/reference/commands.md describes."""
    content = {
        "sources": [_source_json(source) for source in found.sources],
        "num_left_out": found.num_left_out,
    }
    return safe_json(json.dumps(content, indent=2, ensure_ascii=False))


def notes(found: FoundSources) -> list[str]:
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


def _table(sources: Sequence[SourceReport], *, is_narrow: bool) -> Table:
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


def _state(stream: StreamReport) -> Text:
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
