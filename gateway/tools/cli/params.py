"""``rtc3d-gateway params``: query the parameters of servers through their gateways, as lists, JSON or XML."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final, Literal, TextIO

import typer

from gateway.errors import ParametersError, QueryError
from gateway.rtc3d.parameters import (
    SECTIONS,
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
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_json, safe_text
from gateway.tools.cli import options
from gateway.tools.cli.completion import one_of
from gateway.tools.cli.main import exit_with

if TYPE_CHECKING:
    from gateway.client.transport import QueryReply


@options.with_options
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
    zenoh: options.ZenohOption = False,
    lcm: options.LcmOption = False,
    source: options.SourceOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    as_xml: Annotated[bool, typer.Option("--xml", help="Print the server's XML unchanged.")] = False,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Make the gateway query the server now instead of using its cache."),
    ] = False,
    query: options.QueryOptions,
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

    from gateway.client.client import GatewayClient

    with GatewayClient(query.address(lcm=lcm), query.timeout) as client:
        replies, problems = client.parameters(source, wanted, fresh=fresh)
    problems += write_replies(replies, "json" if as_json else "xml" if as_xml else "table", sys.stdout)
    exit_with(problems)


OutputFormat = Literal["table", "json", "xml"]


def write_replies(
    replies: Sequence["QueryReply"], output_format: OutputFormat, out: TextIO
) -> list[QueryError]:
    """Write the parameters of all sources to ``out``; return the problems in them.

    "table" means one list per section, "json" one object with the sources as keys, and "xml" the XML
    unchanged; if there are several replies, a comment with the source and its sections precedes each.
    """
    from gateway.rtc3d.parameters_xml import parse_parameters

    if output_format == "xml":
        for reply in replies:
            if len(replies) > 1:
                out.buffer.write(f"<!-- {reply.source} {' '.join(reply.sections)} -->\n".encode())
            out.buffer.write(reply.content.rstrip(b"\0\r\n") + b"\n")
        return []
    problems: list[QueryError] = []
    merged: dict[str, Parameters] = {}  # of all replies of a source
    ages_s: dict[str, float] = {}  # of the oldest reply
    for reply in replies:
        name = f"source {reply.source!r}"
        parameters = merged.setdefault(reply.source, Parameters())
        if reply.age_s is not None:
            ages_s[reply.source] = max(reply.age_s, ages_s.get(reply.source, reply.age_s))
        try:
            parsed = parse_parameters(reply.content).parameters
        except ParametersError as error:
            problems.append(QueryError(f"{name}: {error}; use --xml to see it", code="unreadable"))
            continue
        fields = {SECTIONS[key].field: SECTIONS[key].of(parsed) for key in reply.sections or SECTIONS}
        missing = [key for key in reply.sections if fields[SECTIONS[key].field] is None]
        if missing:
            text = f"{name}: the server's reply has no section {', '.join(missing)}"
            problems.append(QueryError(text, code="nothing-yet"))
        merged[reply.source] = replace(parameters, **fields)
    if output_format == "json":
        _write_json(merged, ages_s, out)
    else:
        _write_tables(merged, ages_s, out)
    return problems


def _write_json(merged: dict[str, Parameters], ages_s: dict[str, float], out: TextIO) -> None:
    from gateway.queries.answers import parameters_json

    values = {
        source: {
            "age_s": round(ages_s[source], 3) if source in ages_s else None,
            "parameters": json.loads(parameters_json(parameters, "") or b"{}"),
        }
        for source, parameters in merged.items()
    }
    out.buffer.write(safe_json(json.dumps(values, indent=2, ensure_ascii=False)).encode() + b"\n")


def _write_tables(merged: dict[str, Parameters], ages_s: dict[str, float], out: TextIO) -> None:
    from rich.console import Console
    from rich.text import Text

    from gateway.tools.display.terminal import print_list, write_records

    console = Console(file=out)
    separator = "\n" if console.is_terminal else ", "

    def text(value: object) -> str:
        if isinstance(value, tuple):
            return separator.join(map(text, value))
        return safe_text(f"{value:g}" if isinstance(value, float) else "" if value is None else str(value))

    for source, parameters in merged.items():
        for key, section in SECTIONS.items():
            content = section.of(parameters)
            if content is None:
                continue
            title, headings, rows = _list_of(content)
            records = [[text(value) for value in row] for row in rows]
            if console.is_terminal:
                print_list(console, headings, records, title=f"{source}: {title}")
            else:
                write_records(out, [(source, key, *record) for record in records])
        if source in ages_s:
            notes = console if console.is_terminal else Console(stderr=True)
            notes.print(Text(safe_text(f"{source}: parameters are {ages_s[source]:.1f} s old")))


_AnySection = General | Parameters3D | Parameters6D | ParametersAnalog | ParametersForce | ParametersEvents


def _list_of(section: _AnySection) -> tuple[str, Sequence[str], Sequence[Sequence[object]]]:
    """Return the title, the headings and the rows of a section. A value may be a tuple of several texts."""
    rows: list[tuple[object, ...]]
    match section:
        case General():
            rows = [
                ("name", section.name),
                ("version", section.version),
                ("address", section.address),
                ("port", section.port),
                ("frames sent", section.frames_sent),
                ("frames per s", section.frames_per_s),
            ]
            return "general", ("server", ""), rows
        case Parameters3D():
            rows = [(n, each.id, each.label, each.description) for n, each in enumerate(section.markers, 1)]
            title = f"3D, {counted(len(rows), 'marker')}{_rate(section.frequency_hz)}, {section.unit}"
            return title, ("marker", "id", "label", "description"), rows
        case Parameters6D():
            rows = [
                (n, tool.id, tool.label, tool.description, " ".join(tool.marker_ids))
                for n, tool in enumerate(section.tools, 1)
            ]
            title = f"6D, {counted(len(rows), 'tool')}{_rate(section.frequency_hz)}"
            return title, ("tool", "id", "label", "description", "ids of its markers"), rows
        case ParametersAnalog():
            rows = [
                (n, each.id, each.label, each.description, each.unit, each.frequency_hz)
                for n, each in enumerate(section.channels, 1)
            ]
            headings = ("channel", "id", "label", "description", "unit", "Hz")
            return f"analog, {counted(len(rows), 'channel')}", headings, rows
        case ParametersForce():
            rows = [(n, *_plate(plate)) for n, plate in enumerate(section.plates, 1)]
            return f"force, {counted(len(rows), 'plate')}", _PLATE_HEADINGS, rows
        case ParametersEvents():
            rows = []
            for event in section.events:
                texts = []
                for each in event.parameters:
                    values = ", ".join(f"{value.value} {value.label}" for value in each.expected_values)
                    text = f"{each.id} {each.type} {each.description}"
                    texts.append(f"{text} ({values})" if values else text)
                rows.append((event.id, event.label, event.description, tuple(texts)))
            return f"events, {counted(len(rows), 'type')}", ("id", "label", "description", "parameters"), rows


_PLATE_HEADINGS: Final = (
    *("plate", "id", "label", "Hz", "corners", "origin", "channels", "analog ids", "calibration"),
)


def _plate(plate: Plate) -> tuple[object, ...]:
    calibration = []
    if plate.calibration_matrix:
        columns = max(map(len, plate.calibration_matrix))
        size = f"{len(plate.calibration_matrix)} × {columns}"
        calibration.append(f"{size} {plate.calibration_unit}".rstrip())
    if plate.amplifier_gain is not None:
        calibration.append(f"gain {plate.amplifier_gain:g}")
    if plate.excitation_voltage_v is not None:
        calibration.append(f"{plate.excitation_voltage_v:g} V")
    return (
        *(plate.id, plate.label, plate.frequency_hz),
        tuple(map(_point, plate.corners)),
        "" if plate.origin is None else _point(plate.origin),
        tuple(f"{channel.label} {channel.unit}" for channel in plate.channels),
        " ".join(plate.analog_channel_ids),
        tuple(calibration),
    )


def _point(point: Point) -> str:
    return f"{point.x:g} {point.y:g} {point.z:g} {point.unit}"


def _rate(frequency_hz: float | None) -> str:
    return "" if frequency_hz is None else f", {frequency_hz:g} Hz"
