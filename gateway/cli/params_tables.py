"""Lists of a server's parameters (§6), one per section."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

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

_Rows = Sequence[Sequence[object]]


class SectionList(NamedTuple):
    """A section of the parameters: its key, such as "3d", and its items. A value may be a tuple."""

    key: str
    title: str
    headings: Sequence[str]
    rows: _Rows


def section_lists(parameters: Parameters) -> Iterator[SectionList]:
    """Yield a list for each section in ``parameters``."""
    describe: dict[str, Callable[[Any], tuple[str, Sequence[str], _Rows]]] = {
        "general": _general,
        "3d": _markers,
        "6d": _tools,
        "analog": _channels,
        "force": _plates,
        "events": _events,
    }
    for key, section in SECTIONS.items():
        content = section.of(parameters)
        if content is not None:
            yield SectionList(key, *describe[key](content))


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
