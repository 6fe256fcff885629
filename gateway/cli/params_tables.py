"""Tables of a server's parameters (§6), one per section."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from rich.table import Table
from rich.text import Text

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
from gateway.safe_text import safe_text

_Rows = Sequence[Sequence[object]]


def tables(source: str, parameters: Parameters) -> Iterator[Table]:
    """Yield one table for each section in ``parameters``, with ``source`` in its title."""
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


def _cell(value: object) -> str:
    """Return a value as text for a table: "" for None, one line per item of a tuple."""
    if isinstance(value, tuple):
        return "\n".join(map(_cell, value))
    return safe_text(f"{value:g}" if isinstance(value, float) else "" if value is None else str(value))


def _table(title: str, headings: Sequence[str], rows: _Rows) -> Table:
    table = Table(title=Text(_cell(title)), title_justify="left")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        # Text objects, because rich would read square brackets in a string as markup.
        table.add_row(*(Text(_cell(value)) for value in row))
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
