"""The RT server's replies to one client: acknowledgements, errors, parameters, recording control."""

import struct

import pytest

from gateway.rtc3d.parameters_xml import parse_parameters
from tests.unit.rtc3d_server.scripted_client import ScriptedClient
from tests.unit.rtc3d_server.wire import COMMAND, DATA, ERROR, XML

# Events with id 1 (field note 16): frame number -1, time stamp 0.
START_BIG, START_LITTLE = (
    struct.pack(sign + "IIIiqIiqiii", 1, 48, 5, -1, 0, 1, 1, 0, -1, -1, -1) for sign in (">", "<")
)
STOP_BIG, STOP_LITTLE = (start[:28] + bytes(4) + start[32:] for start in (START_BIG, START_LITTLE))


@pytest.fixture
def client() -> ScriptedClient:
    return ScriptedClient()


def test_a_command_is_acknowledged_as_it_was_sent(client: ScriptedClient) -> None:
    """NDI's clients compare the text, without what may follow a command."""
    for sent, end in (
        *((b"Version 1.0", b""), (b"version 1.0", b"\n"), (b"SetByteOrder LittleEndian", b"\0")),
        *((b"StreamFrames", b""), (b"StreamFrames All", b""), (b"StreamFrames Stop", b"")),
        *(
            (b"StreamFrames Frequency:30 3D Analog", b""),
            (b"SendCurrentFrame 3D 6D Analog Force Events", b" "),
        ),
    ):
        assert client.send(sent + end) == [(COMMAND, b"OK-" + sent)]
    assert client.send("BYE\0") == [(COMMAND, b"bye")]  # as NDI's client expects it
    assert client.session.said_bye


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (b"Version 2.0", b"Version 2.0 is not supported; this server speaks version 1.0"),
        *(
            (b"", b"Empty command"),
            (b"\xff\xfe", b"Unknown command"),
            (b"Bye now", b"Bye takes no parameter"),
        ),
        (b"StreamFrames FrequencyDivisor:0", b"Unknown rate 'f"),
        (b"Recording Started", b"Recording takes Start or Stop"),
    ],
)
def test_a_bad_command_gets_an_error_with_why(client: ScriptedClient, sent: bytes, message: bytes) -> None:
    """The text is ASCII, and nothing has changed: a stream goes on with its rate."""
    client.send("StreamFrames 3D")
    [(packet_type, text)] = client.send(sent)
    assert packet_type == ERROR
    assert text.isascii()
    assert text.startswith(b"Error-" + message)
    assert (client.session.said_bye, client.session.is_recording) == (False, False)
    assert client.numbers_until(20_000) == [1, 2, 3]


def test_packets_that_only_servers_send_get_an_error(client: ScriptedClient) -> None:
    """A client's author learns which type commands have."""
    for packet_type in (0, 2, 4, 5, 6, 0xFFFFFFFF):
        text = b"Error-Packets of type %d are not accepted; commands have type 1 (string)" % packet_type
        assert client.send(b"", packet_type) == [(ERROR, text)]


RECORDING = b"Recording Start,file=C:\\My takes\\A b.c3d"


@pytest.mark.parametrize("extra", [b"", b"\n", b"\0", b"\r\n\0"])
@pytest.mark.parametrize(
    ("start", "stop", "packet_type"),
    [
        *((START_BIG, STOP_BIG, DATA), (START_LITTLE, STOP_LITTLE, DATA)),
        *((RECORDING, b"Recording Stop", COMMAND), (b"recording start", b"recording stop", COMMAND)),
    ],
)
def test_a_recording_is_started_and_stopped(
    client: ScriptedClient, start: bytes, stop: bytes, packet_type: int, extra: bytes
) -> None:
    """Field notes 16 to 18: by WaveFront's data frame, which gets no reply, or by commands."""
    for sent, is_recording in ((start, True), (stop, False)):
        replies = [(COMMAND, b"OK-" + sent)] if packet_type == COMMAND else []
        assert client.send(sent + extra, packet_type) == replies
        assert client.session.is_recording is is_recording


@pytest.mark.parametrize(
    ("options", "duration_s"),
    [
        ("", None),
        (",file=take1,duration=5,durationunits=seconds", 5),
        (",DurationUnits=Minutes,Duration = 1.5 ,file=take1.tsv", 90),
    ],
)
def test_the_duration_ends_a_recording(
    client: ScriptedClient, options: str, duration_s: float | None
) -> None:
    """Field note 26, in any order and any case."""
    client.send(f"Recording Start{options}")
    assert client.recording_durations_s == [duration_s]
    client.session.end_recording()
    assert (client.session.is_recording, client.recording_durations_s[1:]) == (False, [None])


@pytest.mark.parametrize("options", [",duration=soon", ",duration=-1", ",duration=5,durationunits=frames"])
def test_a_duration_that_the_server_does_not_understand_is_an_error(
    client: ScriptedClient, options: str
) -> None:
    [(packet_type, text)] = client.send(f"Recording Start{options}")
    assert (packet_type, b"one of seconds, minutes, hours" in text) == (ERROR, True)
    assert not client.session.is_recording


@pytest.mark.parametrize(
    "body",
    [
        b"",
        START_BIG[:-1],
        START_BIG[:12] + bytes(4) + START_BIG[16:],  # frame number 0
        START_BIG[:31] + b"\x02" + START_BIG[32:],  # event 2
        b"\0\0\0\2" + 2 * START_BIG[4:],  # two components
        bytes(4),  # no component
    ],
)
def test_other_data_frames_from_a_client_get_an_error(client: ScriptedClient, body: bytes) -> None:
    """Nothing but exactly this frame starts a recording."""
    [(packet_type, text)] = client.send(body, DATA)
    assert packet_type == ERROR
    assert b"data frame" in text
    assert not client.session.is_recording


def test_the_reply_to_send_parameters_is_xml_with_the_requested_sections(client: ScriptedClient) -> None:
    """§5.3.3: all sections by default."""
    [(packet_type, xml)] = client.send("SendParameters 3d General")
    parameters = parse_parameters(xml).parameters
    assert packet_type == XML
    assert parameters.general is not None
    assert parameters.general.name == "server under test"
    assert parameters.markers == client.scene.parameters.markers
    assert parameters.events is None
    for sent in ("SendParameters", "SendParameters All\0"):
        parameters = parse_parameters(client.send(sent)[0][1]).parameters
        assert None not in (parameters.general, parameters.markers, parameters.events)
