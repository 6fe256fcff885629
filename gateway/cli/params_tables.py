"""A server's parameters (§6) as people and programs want to see them: tables, JSON, XML as it came."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, BinaryIO, Final, Literal, NamedTuple, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.errors import ParametersError, QueryError
from gateway.queries.answers import SECTION_FIELDS, parameters_json
from gateway.rtc3d.parameters import (
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
from gateway.rtc3d.parameters_xml import parse_parameters

Form = Literal["table", "json", "xml"]

Sections = tuple[str, ...]
"""Of SECTIONS; () for all."""

_Rows = Sequence[Sequence[object]]


class Told(NamedTuple):
    """What one source's server says about ``sections``, and how long ago it said so; None: unknown."""

    source: str
    sections: Sections
    xml: bytes
    age_s: float | None


class _Source(NamedTuple):
    """What was told of one source, and the age of the oldest of it."""

    parameters: Parameters
    age_s: float | None


def show(told: Sequence[Told], form: Form, out: TextIO) -> list[QueryError]:
    """Write what servers told; return what is wrong with it.

    A table for each section; or one JSON object, by source; or the XML as it came, a comment with the
    source's name above each if there are several.
    """
    if form == "xml":
        _write_xml(told, out.buffer)
        return []
    problems: list[QueryError] = []
    by_source: dict[str, _Source] = {}
    for each in told:
        before = by_source.get(each.source, _Source(Parameters(), None))
        ages_s = [age_s for age_s in (before.age_s, each.age_s) if age_s is not None]
        parameters = _with_sections(before.parameters, each, problems)
        by_source[each.source] = _Source(parameters, max(ages_s, default=None))
    if form == "json":
        _write_json(by_source, out.buffer)
    else:
        _write_tables(by_source, out)
    return problems


def _with_sections(parameters: Parameters, told: Told, problems: list[QueryError]) -> Parameters:
    """Return ``parameters`` with the sections that were asked for; what is missing is a problem."""
    name = f"source {told.source!r}"
    try:
        found = parse_parameters(told.xml).parameters
    except ParametersError as error:
        problems.append(QueryError(f"{name}: {error}; see it with --xml", code="unreadable"))
        return parameters
    values = {section: getattr(found, SECTION_FIELDS[section]) for section in told.sections or SECTION_FIELDS}
    missing = [section for section, value in values.items() if value is None]
    if told.sections and missing:
        text = f"{name}: the server's answer has no section {', '.join(missing)}"
        problems.append(QueryError(text, code="nothing-yet"))
    return replace(parameters, **{SECTION_FIELDS[section]: value for section, value in values.items()})


def _write_xml(told: Sequence[Told], out: BinaryIO) -> None:
    for each in told:
        if len(told) > 1:
            out.write(f"<!-- {each.source} {' '.join(each.sections)} -->\n".encode())
        out.write(each.xml.rstrip(b"\0\r\n") + b"\n")


def _write_json(by_source: dict[str, _Source], out: BinaryIO) -> None:
    values = {
        source: {
            "age_s": each.age_s and round(each.age_s, 3),
            "parameters": json.loads(parameters_json(each.parameters, "") or b"{}"),
        }
        for source, each in by_source.items()
    }
    out.write(json.dumps(values, indent=2, ensure_ascii=False).encode() + b"\n")


def _write_tables(by_source: dict[str, _Source], out: TextIO) -> None:
    console = Console(file=out)
    for source, each in by_source.items():
        for table in _tables(source, each.parameters):
            console.print(table)
        if each.age_s is not None:
            console.print(Text(_plain(f"{source}: the server said so {each.age_s:.1f} s ago")))


def _tables(source: str, parameters: Parameters) -> Iterator[Table]:
    """Yield one table for each section that ``parameters`` holds; ``source`` begins their titles."""
    sections: tuple[tuple[Any, Callable[[Any], tuple[str, Sequence[str], _Rows]]], ...] = (
        (parameters.general, _general),
        (parameters.markers, _markers),
        (parameters.tools, _tools),
        (parameters.analog, _channels),
        (parameters.force, _plates),
        (parameters.events, _events),
    )
    for section, describe in sections:
        if section is not None:
            title, headings, rows = describe(section)
            yield _table(f"{source}: {title}", headings, rows)


def _plain(value: object) -> str:
    """Return a value fit for a terminal, which no text of a server's may steer: "" for None.

    The items of a tuple stand below each other.
    """
    if isinstance(value, tuple):
        return "\n".join(map(_plain, value))
    text = f"{value:g}" if isinstance(value, float) else "" if value is None else str(value)
    return "".join(each if each.isprintable() else "\N{REPLACEMENT CHARACTER}" for each in text)


def _table(title: str, headings: Sequence[str], rows: _Rows) -> Table:
    table = Table(title=Text(_plain(title)), title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        # As Text, because square brackets in a label are no markup.
        table.add_row(*(Text(_plain(value)) for value in row))
    return table


def _general(general: General) -> tuple[str, Sequence[str], _Rows]:
    rows = (
        ("name", general.name),
        ("version", general.version),
        ("address", general.address),
        ("port", general.port),
        ("frames sent", general.frames_sent),
        ("frames per s", general.frames_per_s),
    )
    return "general", ("server", ""), rows


def _markers(section: Parameters3D) -> tuple[str, Sequence[str], _Rows]:
    title = f"3D, {_count(section.markers, 'marker')}{_rate(section.frequency_hz)}, {section.unit}"
    rows = [
        (number, marker.id, marker.label, marker.description)
        for number, marker in enumerate(section.markers, start=1)
    ]
    return title, ("marker", "id", "label", "description"), rows


def _tools(section: Parameters6D) -> tuple[str, Sequence[str], _Rows]:
    rows = [
        (number, tool.id, tool.label, tool.description, " ".join(tool.marker_ids))
        for number, tool in enumerate(section.tools, start=1)
    ]
    title = f"6D, {_count(section.tools, 'tool')}{_rate(section.frequency_hz)}"
    return title, ("tool", "id", "label", "description", "ids of its markers"), rows


def _channels(section: ParametersAnalog) -> tuple[str, Sequence[str], _Rows]:
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


def _plates(section: ParametersForce) -> tuple[str, Sequence[str], _Rows]:
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


def _events(section: ParametersEvents) -> tuple[str, Sequence[str], _Rows]:
    rows = [
        (event.id, event.label, event.description, tuple(map(_event_parameter, event.parameters)))
        for event in section.events
    ]
    return f"events, {_count(section.events, 'kind')}", ("id", "label", "description", "parameters"), rows


def _event_parameter(parameter: EventParameter) -> str:
    values = ", ".join(f"{value.value} {value.label}" for value in parameter.expected_values)
    return f"{parameter.id} {parameter.type} {parameter.description}" + (f" ({values})" if values else "")


def _point(point: Point) -> str:
    return f"{point.x:g} {point.y:g} {point.z:g} {point.unit}"


def _count(items: Sequence[object], noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"


def _rate(frequency_hz: float | None) -> str:
    return "" if frequency_hz is None else f", {frequency_hz:g} Hz"
