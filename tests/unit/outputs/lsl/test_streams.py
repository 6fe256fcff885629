"""What LSL streams say about themselves: names, types, rates, channels, and the rest of their XML."""

import dataclasses
from typing import Any

import pytest

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.lsl.streams import (
    MAX_RATE_HZ,
    Channel,
    DescribedSource,
    LslStream,
    changed_labels,
    channels_per_item,
    lsl_stream,
    num_labels,
)
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

FORCE_CHANNELS = tuple(
    ForceChannel(str(at), name, unit)
    for at, (name, unit) in enumerate(
        zip(("Fx", "Fy", "Fz", "Mx", "My", "Mz"), ["N"] * 3 + ["Nmm"] * 3, strict=True)
    )
)
PARAMETERS = Parameters(
    general=General(name="First Principles", version="2.1"),
    markers=Parameters3D(100.0, "mm", (Marker("1", "C7"), Marker("2", "LASI"))),
    tools=Parameters6D(50.0, (Tool("1", "Probe"),)),
    analog=ParametersAnalog(
        (
            AnalogChannel("1", "EMG left", unit="uV", frequency_hz=2000.0),
            AnalogChannel("2", "Trigger", unit="V", frequency_hz=2000.0),
        )
    ),
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
    return lsl_stream(DescribedSource("lab", computer, parameters, frame), component, num_items)


def texts(stream: LslStream) -> list[tuple[str, str, str]]:
    return [channel[:3] for channel in stream.channels]


def test_markers_have_positions_in_metres_and_their_reliability() -> None:
    stream = stream_of(ComponentType.MARKERS, 2)
    assert (stream.name, stream.type, stream.rate_hz, stream.is_text) == ("lab_3d", "MoCap", 100.0, False)
    assert texts(stream) == [
        ("C7_X", "PositionX", "meters"),
        ("C7_Y", "PositionY", "meters"),
        ("C7_Z", "PositionZ", "meters"),
        ("C7_reliability", "Reliability", ""),
        ("LASI_X", "PositionX", "meters"),
        ("LASI_Y", "PositionY", "meters"),
        ("LASI_Z", "PositionZ", "meters"),
        ("LASI_reliability", "Reliability", ""),
    ]
    assert {channel.marker for channel in stream.channels} == {"C7", "LASI"}


def test_tools_have_positions_quaternions_as_xdf_names_them_and_errors() -> None:
    stream = stream_of(ComponentType.TOOLS, 1)
    assert (stream.name, stream.type, stream.rate_hz) == ("lab_6d", "MoCap", 50.0)
    assert texts(stream) == [
        ("Probe_X", "PositionX", "meters"),
        ("Probe_Y", "PositionY", "meters"),
        ("Probe_Z", "PositionZ", "meters"),
        ("Probe_quat_X", "OrientationB", "quaternion"),
        ("Probe_quat_Y", "OrientationC", "quaternion"),
        ("Probe_quat_Z", "OrientationD", "quaternion"),
        ("Probe_quat_W", "OrientationA", "quaternion"),
        ("Probe_error", "Error", "meters"),
    ]
    assert {channel.object for channel in stream.channels} == {"Probe"}


def test_analog_channels_keep_the_units_of_the_server() -> None:
    stream = stream_of(ComponentType.ANALOG, 2)
    assert (stream.name, stream.type, stream.rate_hz) == ("lab_analog", "Analog", 2000.0)
    assert texts(stream) == [("EMG left", "EMG", "uV"), ("Trigger", "Analog", "V")]


def test_a_stream_of_nothing_but_emg_is_of_that_type() -> None:
    analog = ParametersAnalog(tuple(AnalogChannel(str(at), f"EMG {at}") for at in range(3)))
    assert stream_of(ComponentType.ANALOG, 3, Parameters(analog=analog)).type == "EMG"


def test_plates_have_forces_and_moments_in_the_units_of_the_server() -> None:
    stream = stream_of(ComponentType.FORCE, 1)
    assert (stream.name, stream.type, stream.rate_hz) == ("lab_force", "Force", 1000.0)
    assert texts(stream) == [
        ("Walkway_FX", "ForceX", "N"),
        ("Walkway_FY", "ForceY", "N"),
        ("Walkway_FZ", "ForceZ", "N"),
        ("Walkway_MX", "MomentX", "Nmm"),
        ("Walkway_MY", "MomentY", "Nmm"),
        ("Walkway_MZ", "MomentZ", "Nmm"),
    ]


def test_events_are_text_markers_without_a_rate() -> None:
    stream = stream_of(ComponentType.EVENT, 1)
    assert (stream.name, stream.type, stream.rate_hz, stream.is_text) == ("lab_event", "Markers", 0.0, True)
    assert texts(stream) == [("event", "Marker", "")]


@pytest.mark.parametrize("component", WIRE_ORDER)
def test_without_parameters_items_are_called_by_their_position(component: ComponentType) -> None:
    stream = stream_of(component, 3, Parameters())
    is_event = component is ComponentType.EVENT
    assert len(stream.channels) == (1 if is_event else 3 * channels_per_item(component))
    assert len({channel.label for channel in stream.channels}) == len(stream.channels)
    assert stream.rate_hz == 0.0


def test_the_xml_has_channels_setup_and_acquisition() -> None:
    tree: dict[str, Any] = dict(stream_of(ComponentType.TOOLS, 1).tree)
    assert tree["channels"][0] == (
        "channel",
        (("label", "Probe_X"), ("type", "PositionX"), ("unit", "meters"), ("object", "Probe")),
    )
    setup = dict(tree["setup"])
    assert setup["name"] == "lab"
    assert setup["objects"] == (("object", (("class", "Rigid"), ("label", "Probe"))),)
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
    source = DescribedSource("lab", "lab-pc", Parameters(tools=tools), FRAME)
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


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf"), 1e9, MAX_RATE_HZ + 1, None])
def test_a_rate_that_cannot_be_is_not_announced(rate_hz: float | None) -> None:
    """liblsl would reserve memory for it."""
    parameters = Parameters(markers=Parameters3D(rate_hz, "mm", (Marker("1", "C7"),)))
    assert stream_of(ComponentType.MARKERS, 1, parameters).rate_hz == 0.0


def test_a_rate_of_too_many_values_is_not_announced() -> None:
    parameters = Parameters(markers=Parameters3D(1000.0, "mm"))
    assert stream_of(ComponentType.MARKERS, 600, parameters).rate_hz == 1000.0
    assert stream_of(ComponentType.MARKERS, 700, parameters).rate_hz == 0.0


def test_the_number_of_described_items_comes_from_the_parameters() -> None:
    assert [num_labels(component, PARAMETERS) for component in WIRE_ORDER] == [
        {"3d": 2, "6d": 1, "analog": 2, "force": 1, "event": 1}[component.key] for component in WIRE_ORDER
    ]
    assert [num_labels(component, Parameters()) for component in WIRE_ORDER] == [None] * 5


def test_channels() -> None:
    assert Channel("label", "type", "").tree == ("channel", (("label", "label"), ("type", "type")))
