"""The output of ``params``: lists, JSON, or the server's XML unchanged."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import BinaryIO, Literal, NamedTuple, TextIO

from rich.console import Console
from rich.text import Text

from gateway.cli.params_query import ParametersReply
from gateway.cli.params_tables import section_lists
from gateway.errors import ParametersError, QueryError
from gateway.queries.answers import parameters_json
from gateway.rtc3d.parameters import SECTIONS, Parameters
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.safe_text import safe_json, safe_text
from gateway.terminal.lists import print_list, write_records

OutputFormat = Literal["table", "json", "xml"]


class _SourceParameters(NamedTuple):
    """The parameters of one source, merged from its replies, and the age of the oldest reply in s."""

    parameters: Parameters
    age_s: float | None


def write_replies(
    replies: Sequence[ParametersReply], output_format: OutputFormat, out: TextIO
) -> list[QueryError]:
    """Write the parameters of all sources to ``out``; return the problems in them.

    "table" means one list per section, "json" one object with the sources as keys, and "xml" the XML
    unchanged; if there are several replies, a comment with the source and its sections precedes each.
    """
    if output_format == "xml":
        _write_xml(replies, out.buffer)
        return []
    problems: list[QueryError] = []
    by_source: dict[str, _SourceParameters] = {}
    for reply in replies:
        merged = by_source.get(reply.source, _SourceParameters(Parameters(), None))
        ages_s = [age_s for age_s in (merged.age_s, reply.age_s) if age_s is not None]
        parameters = _merge(merged.parameters, reply, problems)
        by_source[reply.source] = _SourceParameters(parameters, max(ages_s, default=None))
    if output_format == "json":
        _write_json(by_source, out.buffer)
    else:
        _write_tables(by_source, out)
    return problems


def _merge(parameters: Parameters, reply: ParametersReply, problems: list[QueryError]) -> Parameters:
    """Return ``parameters`` with the sections of ``reply``; append problems to ``problems``."""
    name = f"source {reply.source!r}"
    try:
        parsed = parse_parameters(reply.xml).parameters
    except ParametersError as error:
        problems.append(QueryError(f"{name}: {error}; use --xml to see it", code="unreadable"))
        return parameters
    fields = {SECTIONS[key].field: SECTIONS[key].of(parsed) for key in reply.sections or SECTIONS}
    missing = [key for key in reply.sections if fields[SECTIONS[key].field] is None]
    if missing:
        text = f"{name}: the server's reply has no section {', '.join(missing)}"
        problems.append(QueryError(text, code="nothing-yet"))
    return replace(parameters, **fields)


def _write_xml(replies: Sequence[ParametersReply], out: BinaryIO) -> None:
    for reply in replies:
        if len(replies) > 1:
            out.write(f"<!-- {reply.source} {' '.join(reply.sections)} -->\n".encode())
        out.write(reply.xml.rstrip(b"\0\r\n") + b"\n")


def _write_json(by_source: dict[str, _SourceParameters], out: BinaryIO) -> None:
    values = {
        source: {
            "age_s": None if merged.age_s is None else round(merged.age_s, 3),
            "parameters": json.loads(parameters_json(merged.parameters, "") or b"{}"),
        }
        for source, merged in by_source.items()
    }
    out.write(safe_json(json.dumps(values, indent=2, ensure_ascii=False)).encode() + b"\n")


def _write_tables(by_source: dict[str, _SourceParameters], out: TextIO) -> None:
    console = Console(file=out)
    for source, merged in by_source.items():
        for section in section_lists(merged.parameters):
            records = [[_text(value, console) for value in row] for row in section.rows]
            if console.is_terminal:
                print_list(console, section.headings, records, title=f"{source}: {section.title}")
            else:
                write_records(out, [(source, section.key, *record) for record in records])
        if merged.age_s is not None:
            notes = console if console.is_terminal else Console(stderr=True)
            notes.print(Text(safe_text(f"{source}: parameters are {merged.age_s:.1f} s old")))


def _text(value: object, console: Console) -> str:
    """Return a value as text: "" for None; one line per item of a tuple on a terminal."""
    if isinstance(value, tuple):
        return ("\n" if console.is_terminal else ", ").join(_text(item, console) for item in value)
    return safe_text(f"{value:g}" if isinstance(value, float) else "" if value is None else str(value))
