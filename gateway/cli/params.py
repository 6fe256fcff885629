"""``rtc3d-gateway params``: query the parameters of servers through their gateways, as lists, JSON or XML."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Final, Literal, NamedTuple, TextIO

import typer

from gateway.cli.options import QueryOptions, SourceOption, one_of, with_options
from gateway.errors import ParametersError, QueryError
from gateway.logs.safe_text import safe_json, safe_text
from gateway.rtc3d.parameters import (
    SECTIONS,
    EventParameter,
    General,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
)

if TYPE_CHECKING:
    from rich.console import Console

    from gateway.client.transport import Reply


@with_options
def params(
    sections: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SECTION",
            autocompletion=one_of(SECTIONS),
            help=f"Any of {', '.join(SECTIONS)}; the default is all.",
        ),
    ] = None,
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Query on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Query on LCM.")] = False,
    source: SourceOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, with the sources as keys.")
    ] = False,
    as_xml: Annotated[bool, typer.Option("--xml", help="Print the server's XML unchanged.")] = False,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Make the gateway query the server now instead of using its cache."),
    ] = False,
    query: QueryOptions,
) -> None:
    """Query the parameters of servers through their gateways: markers, tools, channels, plates, events.

    Exit status 3: no gateway found; 4: its server is not connected; 5: no reply in time; 1: anything else.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    if query.zenoh_config is not None and lcm:
        raise typer.BadParameter("--zenoh-config is for queries on Zenoh")
    if as_json and as_xml:
        raise typer.BadParameter("give either --json or --xml")
    wanted = tuple(dict.fromkeys(sections or ()))
    if unknown := set(wanted) - set(SECTIONS):
        raise typer.BadParameter(f"unknown section {min(unknown)!r}; known sections: {', '.join(SECTIONS)}")

    from gateway.cli.main import exit_with
    from gateway.client.client import GatewayClient

    with GatewayClient(query.address(lcm=lcm), query.timeout) as client:
        replies, problems = client.parameters(source, wanted, fresh=fresh)
    problems += write_replies(replies, "json" if as_json else "xml" if as_xml else "table", sys.stdout)
    exit_with(problems)


OutputFormat = Literal["table", "json", "xml"]


class _SourceParameters(NamedTuple):
    """The parameters of one source, merged from its replies, and the age of the oldest reply in s."""

    parameters: Parameters
    age_s: float | None


def write_replies(replies: Sequence["Reply"], output_format: OutputFormat, out: TextIO) -> list[QueryError]:
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


def _merge(parameters: Parameters, reply: "Reply", problems: list[QueryError]) -> Parameters:
    """Return ``parameters`` with the sections of ``reply``; append problems to ``problems``."""
    from gateway.rtc3d.parameters_xml import parse_parameters

    name = f"source {reply.source!r}"
    try:
        parsed = parse_parameters(reply.content).parameters
    except ParametersError as error:
        problems.append(QueryError(f"{name}: {error}; use --xml to see it", code="unreadable"))
        return parameters
    fields = {SECTIONS[key].field: SECTIONS[key].of(parsed) for key in reply.sections or SECTIONS}
    missing = [key for key in reply.sections if fields[SECTIONS[key].field] is None]
    if missing:
        text = f"{name}: the server's reply has no section {', '.join(missing)}"
        problems.append(QueryError(text, code="nothing-yet"))
    return replace(parameters, **fields)


def _write_xml(replies: Sequence["Reply"], out: BinaryIO) -> None:
    for reply in replies:
        if len(replies) > 1:
            out.write(f"<!-- {reply.source} {' '.join(reply.sections)} -->\n".encode())
        out.write(reply.content.rstrip(b"\0\r\n") + b"\n")


def _write_json(by_source: dict[str, _SourceParameters], out: BinaryIO) -> None:
    from gateway.queries.answers import parameters_json

    values = {
        source: {
            "age_s": None if merged.age_s is None else round(merged.age_s, 3),
            "parameters": json.loads(parameters_json(merged.parameters, "") or b"{}"),
        }
        for source, merged in by_source.items()
    }
    out.write(safe_json(json.dumps(values, indent=2, ensure_ascii=False)).encode() + b"\n")


def _write_tables(by_source: dict[str, _SourceParameters], out: TextIO) -> None:
    from rich.console import Console
    from rich.text import Text

    from gateway.display.terminal import print_list, write_records

    console = Console(file=out)
    for source, merged in by_source.items():
        for key, section in SECTIONS.items():
            content = section.of(merged.parameters)
            if content is None:
                continue
            title, headings, rows = _LISTS[key](content)
            records = [[_text(value, console) for value in row] for row in rows]
            if console.is_terminal:
                print_list(console, headings, records, title=f"{source}: {title}")
            else:
                write_records(out, [(source, key, *record) for record in records])
        if merged.age_s is not None:
            notes = console if console.is_terminal else Console(stderr=True)
            notes.print(Text(safe_text(f"{source}: parameters are {merged.age_s:.1f} s old")))


def _text(value: object, console: "Console") -> str:
    """Return a value as text: "" for None; one line per item of a tuple on a terminal."""
    if isinstance(value, tuple):
        return ("\n" if console.is_terminal else ", ").join(_text(item, console) for item in value)
    return safe_text(f"{value:g}" if isinstance(value, float) else "" if value is None else str(value))


_List = tuple[str, Sequence[str], Sequence[Sequence[object]]]
"""A section of the parameters: its title, headings and rows. A value may be a tuple."""


def _general(general: General) -> _List:
    rows = (
        ("name", general.name),
        ("version", general.version),
        ("address", general.address),
        ("port", general.port),
        ("frames sent", general.frames_sent),
        ("frames per s", general.frames_per_s),
    )
    return "general", ("server", ""), rows


def _markers(section: Parameters3D) -> _List:
    title = f"3D, {_count(section.markers, 'marker')}{_rate(section.frequency_hz)}, {section.unit}"
    rows = [
        (number, marker.id, marker.label, marker.description)
        for number, marker in enumerate(section.markers, start=1)
    ]
    return title, ("marker", "id", "label", "description"), rows


def _tools(section: Parameters6D) -> _List:
    rows = [
        (number, tool.id, tool.label, tool.description, " ".join(tool.marker_ids))
        for number, tool in enumerate(section.tools, start=1)
    ]
    title = f"6D, {_count(section.tools, 'tool')}{_rate(section.frequency_hz)}"
    return title, ("tool", "id", "label", "description", "ids of its markers"), rows


def _channels(section: ParametersAnalog) -> _List:
    rows = [
        (number, channel.id, channel.label, channel.description, channel.unit, channel.frequency_hz)
        for number, channel in enumerate(section.channels, start=1)
    ]
    title = f"analog, {_count(section.channels, 'channel')}"
    return title, ("channel", "id", "label", "description", "unit", "Hz"), rows


_PLATE_HEADINGS: Final = (
    "plate",
    "id",
    "label",
    "Hz",
    "corners",
    "origin",
    "channels",
    "analog ids",
    "calibration",
)


def _plates(section: ParametersForce) -> _List:
    rows = [
        (
            number,
            plate.id,
            plate.label,
            plate.frequency_hz,
            tuple(map(_point, plate.corners)),
            "" if plate.origin is None else _point(plate.origin),
            tuple(f"{channel.label} {channel.unit}" for channel in plate.channels),
            " ".join(plate.analog_channel_ids),
            _calibration(plate),
        )
        for number, plate in enumerate(section.plates, start=1)
    ]
    return f"force, {_count(section.plates, 'plate')}", _PLATE_HEADINGS, rows


def _calibration(plate: Plate) -> tuple[str, ...]:
    texts = []
    if plate.calibration_matrix:
        columns = max(map(len, plate.calibration_matrix))
        texts.append(f"{len(plate.calibration_matrix)} × {columns} {plate.calibration_unit}".rstrip())
    if plate.amplifier_gain is not None:
        texts.append(f"gain {plate.amplifier_gain:g}")
    if plate.excitation_voltage_v is not None:
        texts.append(f"{plate.excitation_voltage_v:g} V")
    return tuple(texts)


def _events(section: ParametersEvents) -> _List:
    rows = [
        (event.id, event.label, event.description, tuple(map(_event_parameter, event.parameters)))
        for event in section.events
    ]
    return f"events, {_count(section.events, 'type')}", ("id", "label", "description", "parameters"), rows


def _event_parameter(parameter: EventParameter) -> str:
    values = ", ".join(f"{value.value} {value.label}" for value in parameter.expected_values)
    return f"{parameter.id} {parameter.type} {parameter.description}" + (f" ({values})" if values else "")


def _point(point: Point) -> str:
    return f"{point.x:g} {point.y:g} {point.z:g} {point.unit}"


def _count(items: Sequence[object], noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"


def _rate(frequency_hz: float | None) -> str:
    return "" if frequency_hz is None else f", {frequency_hz:g} Hz"


_LISTS: Final[dict[str, Callable[[Any], _List]]] = {
    "general": _general,
    "3d": _markers,
    "6d": _tools,
    "analog": _channels,
    "force": _plates,
    "events": _events,
}
"""How each section is listed, by its key."""
