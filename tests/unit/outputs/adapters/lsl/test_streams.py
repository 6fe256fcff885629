"""What LSL streams say about themselves, and what the doctor says about streams."""

import dataclasses
import socket
from pathlib import Path
from typing import Any

import pytest

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.adapters.lsl import checks
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.lsl.streams import (
    CHANNELS_PER_ITEM,
    MAX_RATE_HZ,
    LslSource,
    LslStream,
    changed_labels,
    lsl_stream,
    num_labels,
)
from gateway.outputs.findings import Result
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    ForceChannel,
    General,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)
from tests.support.lsl_receiver import lsl_config

UNITS = {"Fx": "N", "Fy": "N", "Fz": "N", "Mx": "Nmm", "My": "Nmm", "Mz": "Nmm"}
FORCE_CHANNELS = tuple(ForceChannel(str(at), name, unit) for at, (name, unit) in enumerate(UNITS.items()))
ANALOG_CHANNELS = (
    AnalogChannel("1", "EMG left", unit="uV", frequency_hz=2000.0),
    AnalogChannel("2", "Trigger", unit="V", frequency_hz=2000.0),
)
PARAMETERS = Parameters(
    general=General(name="First Principles", version="2.1"),
    markers=Parameters3D(100.0, "mm", (Marker("1", "C7"), Marker("2", "LASI"))),
    tools=Parameters6D(50.0, (Tool("1", "Probe"),)),
    analog=ParametersAnalog(ANALOG_CHANNELS),
    force=ParametersForce((Plate("1", "Walkway", 1000.0, channels=FORCE_CHANNELS),)),
    events=ParametersEvents((EventDefinition("7", "Button"),)),
)
FRAME = CoordinateFrame("world", 1e-3, (0.0, 0.0, 0.0, 1.0), (1.0, 2.0, 3.0))


def stream_of(
    component: ComponentType,
    num_items: int,
    parameters: Parameters = PARAMETERS,
    frame: CoordinateFrame = FRAME,
    computer: str = "lab-pc",
) -> LslStream:
    return lsl_stream(LslSource("lab", computer, parameters, frame), component, num_items)


def positions(name: str) -> list[tuple[str, str, str]]:
    return [(f"{name}_{axis}", f"Position{axis}", "meters") for axis in "XYZ"]


def marker(name: str) -> list[tuple[str, str, str]]:
    return [*positions(name), (f"{name}_reliability", "Reliability", "")]


PROBE = [
    *positions("Probe"),  # XDF names the parts of a quaternion A to D, beginning with the scalar
    *(
        (f"Probe_quat_{names[0]}", f"Orientation{names[1]}", "quaternion")
        for names in ("XB", "YC", "ZD", "WA")
    ),
    ("Probe_error", "Error", "meters"),
]
ELECTRODES = [("EMG left", "EMG", "uV"), ("Trigger", "Analog", "V")]
FORCES = [(f"Walkway_F{axis}", f"Force{axis}", "N") for axis in "XYZ"]
MOMENTS = [(f"Walkway_M{axis}", f"Moment{axis}", "Nmm") for axis in "XYZ"]


@pytest.mark.parametrize(
    ("component", "num_items", "facts", "channels"),
    [
        (ComponentType.MARKERS, 2, ("lab_3d", "MoCap", 100.0, False), marker("C7") + marker("LASI")),
        (ComponentType.TOOLS, 1, ("lab_6d", "MoCap", 50.0, False), PROBE),
        (ComponentType.ANALOG, 2, ("lab_analog", "Analog", 2000.0, False), ELECTRODES),
        (ComponentType.FORCE, 1, ("lab_force", "Force", 1000.0, False), FORCES + MOMENTS),
        (ComponentType.EVENT, 1, ("lab_event", "Markers", 0.0, True), [("event", "Marker", "")]),
    ],
)
def test_channels_have_the_labels_types_and_units_of_the_server(
    component: ComponentType, num_items: int, facts: tuple[object, ...], channels: list[tuple[str, str, str]]
) -> None:
    stream = stream_of(component, num_items)
    assert (stream.name, stream.type, stream.rate_hz, stream.is_text) == facts
    assert [channel[:3] for channel in stream.channels] == channels
    if component is ComponentType.MARKERS:
        assert {channel.marker for channel in stream.channels} == {"C7", "LASI"}


def test_a_stream_of_nothing_but_emg_is_of_that_type() -> None:
    analog = ParametersAnalog(tuple(AnalogChannel(str(at), f"EMG {at}") for at in range(3)))
    assert stream_of(ComponentType.ANALOG, 3, Parameters(analog=analog)).type == "EMG"


@pytest.mark.parametrize("component", WIRE_ORDER)
def test_without_parameters_items_are_called_by_their_position(component: ComponentType) -> None:
    stream = stream_of(component, 3, Parameters())
    is_event = component is ComponentType.EVENT
    assert len(stream.channels) == (1 if is_event else 3 * CHANNELS_PER_ITEM[component])
    assert len({channel.label for channel in stream.channels}) == len(stream.channels)
    assert stream.rate_hz == 0.0


def test_the_xml_has_channels_setup_and_acquisition() -> None:
    tree: dict[str, Any] = dict(stream_of(ComponentType.TOOLS, 1).tree)
    assert tree["channels"][0] == (
        "channel",
        (("label", "Probe_X"), ("type", "PositionX"), ("unit", "meters"), ("object", "Probe")),
    )
    setup = dict(tree["setup"])
    objects = (("object", (("class", "Rigid"), ("label", "Probe"))),)
    assert (setup["name"], setup["objects"]) == ("lab", objects)
    frame = dict(setup["coordinate_frame"])
    assert frame["frame_id"] == "world"
    assert frame["translation_from_server"] == (("x", "1.0"), ("y", "2.0"), ("z", "3.0"))
    assert dict(tree["acquisition"])["model"] == "First Principles"
    assert tree["synchronization"] == (("can_drop_samples", "true"),)


def test_labels_are_printable_unique_and_short() -> None:
    labels = ("", "\x1b[2J", "\x00", "same", "same", "é" * 300, "<b>&", "\ud7ff", "a\nb")
    markers = Parameters3D(100.0, "mm", tuple(Marker(str(at), label) for at, label in enumerate(labels)))
    channels = stream_of(ComponentType.MARKERS, len(labels), Parameters(markers=markers)).channels
    found = [channel.label for channel in channels]
    assert len(set(found)) == len(found)
    assert all(label.isprintable() and 0 < len(label.encode()) < 150 for label in found)
    assert found[0] == "marker 1_X"


def test_labels_that_a_stream_cannot_use_are_known() -> None:
    tools = Parameters6D(50.0, tuple(Tool("1", label) for label in ("Wand", "Wand", "a\x00b", "Probe")))
    source = LslSource("lab", "lab-pc", Parameters(tools=tools), FRAME)
    assert changed_labels(source, ComponentType.TOOLS, 4) == {"Wand": "Wand_2", "a\x00b": "a_b"}
    assert changed_labels(source, ComponentType.EVENT, 1) == {}


def test_the_source_id_is_stable_and_differs_for_other_channels() -> None:
    """A program that has lost a stream continues with the next one of this id, whatever its labels are."""
    first = stream_of(ComponentType.TOOLS, 1)
    assert first.source_id.startswith("rtc3d-gateway/lab-pc/lab/6d/")
    assert first.source_id == stream_of(ComponentType.TOOLS, 1).source_id
    renamed = dataclasses.replace(PARAMETERS, tools=Parameters6D(50.0, (Tool("1", "Other"),)))
    faster = dataclasses.replace(PARAMETERS, tools=Parameters6D(60.0, (Tool("1", "Probe"),)))
    others = {
        stream_of(ComponentType.TOOLS, 2).source_id,
        stream_of(ComponentType.TOOLS, 1, renamed).source_id,
        stream_of(ComponentType.TOOLS, 1, frame=CoordinateFrame("world")).source_id,
        stream_of(ComponentType.TOOLS, 1, computer="other").source_id,
    }
    assert len(others | {first.source_id}) == 5
    assert stream_of(ComponentType.TOOLS, 1, faster).source_id == first.source_id


@pytest.mark.parametrize(
    ("rate_hz", "num_items", "announced_hz"),
    [
        *((rate_hz, 1, 0.0) for rate_hz in (0.0, -1.0, float("nan"), float("inf"), MAX_RATE_HZ + 1, None)),
        pytest.param(1000.0, 600, 1000.0, id="as many values as there can be"),
        pytest.param(1000.0, 700, 0.0, id="too many values"),
    ],
)
def test_no_impossible_rate_is_announced(rate_hz: float | None, num_items: int, announced_hz: float) -> None:
    """liblsl would reserve memory for it."""
    parameters = Parameters(markers=Parameters3D(rate_hz, "mm"))
    assert stream_of(ComponentType.MARKERS, num_items, parameters).rate_hz == announced_hz


def test_the_number_of_described_items_comes_from_the_parameters() -> None:
    assert [num_labels(component, PARAMETERS) for component in WIRE_ORDER] == [2, 1, 2, 1, 1]
    assert [num_labels(component, Parameters()) for component in WIRE_ORDER] == [None] * 5


def test_streams_of_a_source_whose_name_begins_alike_are_not_those_of_this_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = ("doctor_event", "lab_2_3d", "lab_2_event")
    streams = [{"computer": socket.gethostname(), "name": name} for name in names]
    monkeypatch.setattr(checks, "_find_streams", lambda *_: streams)
    settings = LslSettings(enabled=True, config=str(lsl_config(tmp_path)))
    opens, found, gateway = checks.check_lsl(settings, ["lab", "lab_2"], [], 20.0)
    assert (opens.result, found.result) == (Result.PASSING, Result.PASSING)
    assert gateway.result is Result.WARNING
    assert "lab_2" in gateway.found
