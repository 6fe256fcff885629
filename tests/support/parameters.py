"""Parameters of servers: as outputs get them, and the specification's examples in §6.

These are the XML, word for word, and the parameters as a human reads them.
"""

from pathlib import Path

from gateway.config.settings import SourceSettings
from gateway.messages.descriptions.source_frame import source_frame
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
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
    Point,
    Tool,
)
from gateway.rtc3d.parameters_xml import parse_parameters

SPEC_XML = Path(__file__).parents[1] / "data" / "spec_xml"

GENERAL = General(
    name="",
    version="1.02.03",
    address="192.168.0.20",
    port=12345,
    frames_sent=123456,
    frames_per_s=33.12,
)
MARKERS = Parameters3D(frequency_hz=60.0, unit="mm", markers=(Marker(id="1", label="marker 1"),))
TOOLS = Parameters6D(frequency_hz=60.0, tools=(Tool(id="1", marker_ids=("12", "14", "20")),))
ANALOG = ParametersAnalog((AnalogChannel(id="1", label="EMG1", unit="mV", frequency_hz=2400.0),))
PLATE = Plate(
    id="1",
    label="First force plate",
    frequency_hz=2400.0,
    corners=(
        Point(1000.0, 0.0, 0.0, "mm"),
        Point(1600.0, 0.0, 0.0, "mm"),
        Point(1600.0, 400.0, 0.0, "mm"),
        Point(1000.0, 400.0, 0.0, "mm"),
    ),
    origin=Point(-4.0, 5.0, -40.0, "mm"),
    channels=(
        ForceChannel("1", "Force X", "N"),
        ForceChannel("2", "Force Y", "N"),
        ForceChannel("6", "Moment Z", "Nm"),
    ),
    analog_channel_ids=("analog channel id", "6", "7", "8", "8", "10"),
    excitation_voltage_v=5.0,
    amplifier_gain=4000.0,
    calibration_unit="microV",
    calibration_matrix=((1.0, 0.0, 0.0, 0.0, 0.0, 0.0),),
)
FORCE = ParametersForce((PLATE,))
EVENTS = ParametersEvents(
    (
        EventDefinition(
            id="0x123456",
            label="Button",
            description="Button action",
            parameters=(
                EventParameter(id="1", type="int", description="Button id number"),
                EventParameter(
                    id="2",
                    type="int",
                    description="ON/OFF state",
                    expected_values=(
                        ExpectedValue("1", "1", "ON", "Button was pressed"),
                        ExpectedValue("2", "0", "OFF", "Button was released"),
                    ),
                ),
            ),
        ),
    )
)
ALL = Parameters(GENERAL, MARKERS, TOOLS, ANALOG, FORCE, EVENTS)
BY_SECTION = {
    "general": Parameters(general=GENERAL),
    "3d": Parameters(markers=MARKERS),
    "6d": Parameters(tools=TOOLS),
    "analog": Parameters(analog=ANALOG),
    "force": Parameters(force=FORCE),
    "events": Parameters(events=EVENTS),
}


def spec_xml(section: str) -> bytes:
    """Return the specification's example of the section with its mistakes, but without page breaks."""
    return (SPEC_XML / f"{section}.xml").read_bytes()


def spec_body(section: str) -> bytes:
    """Return the section's element in the specification's example, without the root element."""
    return spec_xml(section).partition(b"\n")[2].rpartition(b"</RT_Parameters")[0]


def in_root(*sections: str) -> bytes:
    """Return XML with these sections in a root element RT_Parameters."""
    return "\n".join(("<RT_Parameters Ver='1.00'>", *sections, "</RT_Parameters>")).encode()


def markers_of(xml: bytes) -> Parameters3D:
    """Return the 3D section of XML; assert that it has no faults."""
    parameters, recovered = parse_parameters(xml)
    assert recovered == ()
    assert parameters.markers is not None
    return parameters.markers


def in_metres(parameters: Parameters, source: str = "lab") -> ServerParameters:
    """Return parameters of a source without a transform: poses are in metres, in the server's axes."""
    frame = source_frame(SourceSettings(name=source, host="192.0.2.20"), parameters)
    return ServerParameters(b"", 1, 1, parsed=parameters, frame=frame)
