import pytest

from gateway.rtc3d.parameters_xml import parse_parameters
from tests.unit.rtc3d_server.scripted_client import ScriptedClient
from tests.unit.rtc3d_server.wire import COMMAND, DATA, ERROR, XML


@pytest.fixture
def client() -> ScriptedClient:
    return ScriptedClient()


@pytest.mark.parametrize(
    ("sent", "acknowledged"),
    [
        (b"Version 1.0", b"OK-Version 1.0"),
        (b"Version 1.0\0", b"OK-Version 1.0"),
        (b"version 1.0\n", b"OK-version 1.0"),
        (b"SetByteOrder LittleEndian\0", b"OK-SetByteOrder LittleEndian"),
        (b"SETBYTEORDER BIGENDIAN", b"OK-SETBYTEORDER BIGENDIAN"),
        (b"StreamFrames", b"OK-StreamFrames"),
        (b"StreamFrames All", b"OK-StreamFrames All"),
        (
            b"StreamFrames AllFrames 3D 6D Analog Force Events ",
            b"OK-StreamFrames AllFrames 3D 6D Analog Force Events",
        ),
        (b"StreamFrames Frequency:30 3D Analog", b"OK-StreamFrames Frequency:30 3D Analog"),
        (b"StreamFrames FrequencyDivisor:4", b"OK-StreamFrames FrequencyDivisor:4"),
        (b"StreamFrames Stop", b"OK-StreamFrames Stop"),
        (b"SendCurrentFrame", b"OK-SendCurrentFrame"),
        (b"SendCurrentFrame 3D 6D Analog Force Events ", b"OK-SendCurrentFrame 3D 6D Analog Force Events"),
    ],
)
def test_a_command_is_acknowledged_as_it_was_sent(
    client: ScriptedClient, sent: bytes, acknowledged: bytes
) -> None:
    assert client.send(sent) == [(COMMAND, acknowledged)]


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (b"Version 2.0", b"Version 2.0 is not supported; this server speaks version 1.0"),
        (b"Version", b"Version takes one parameter n.n, as in: Version 1.0"),
        (b"SetByteOrder Middle", b"SetByteOrder takes one parameter, BigEndian or LittleEndian"),
        (b"", b"Empty command"),
        (b"Bye now", b"Bye takes no parameter"),
    ],
)
def test_a_bad_command_gets_an_error_that_says_why(
    client: ScriptedClient, sent: bytes, message: bytes
) -> None:
    [(packet_type, text)] = client.send(sent)

    assert packet_type == ERROR
    assert text.startswith(b"Error-" + message)


@pytest.mark.parametrize(
    "sent",
    [b"Play", b"StreamFrames Sometimes", b"StreamFrames Frequency:0", b"SendParameters 4D", b"\xff\xfe"],
)
def test_unknown_commands_get_an_error_in_ascii(client: ScriptedClient, sent: bytes) -> None:
    [(packet_type, text)] = client.send(sent)

    assert packet_type == ERROR
    assert text.isascii()
    assert text.startswith(b"Error-")


def test_a_refused_command_changes_nothing(client: ScriptedClient) -> None:
    client.send("StreamFrames 3D")
    client.send("StreamFrames FrequencyDivisor:0")

    assert client.numbers_until(20_000) == [1, 2, 3]


@pytest.mark.parametrize("packet_type", [0, 2, 4, 5, 6, 0xFFFFFFFF])
def test_packets_that_only_servers_send_get_an_error(client: ScriptedClient, packet_type: int) -> None:
    [(reply_type, text)] = client.send(b"", packet_type)

    assert (reply_type, text) == (
        ERROR,
        b"Error-Packets of type %d are not accepted; commands have type 1 (string)" % packet_type,
    )


def test_bye_gets_the_reply_that_ndis_client_expects(client: ScriptedClient) -> None:
    assert client.send("BYE\0") == [(COMMAND, b"bye")]
    assert client.session.said_bye


# One event component of 48 bytes, frame number -1, time stamp 0, one event with id 1 (field note 16).
START_BIG = bytes.fromhex(
    "00000001 00000030 00000005 FFFFFFFF 0000000000000000 00000001"
    "00000001 0000000000000000 FFFFFFFF FFFFFFFF FFFFFFFF"
)
START_LITTLE = bytes.fromhex(
    "01000000 30000000 05000000 FFFFFFFF 0000000000000000 01000000"
    "01000000 0000000000000000 FFFFFFFF FFFFFFFF FFFFFFFF"
)


@pytest.mark.parametrize(
    ("start", "stop"),
    [
        (START_BIG, START_BIG[:28] + bytes(4) + START_BIG[32:]),
        (START_LITTLE, START_LITTLE[:28] + bytes(4) + START_LITTLE[32:]),
    ],
    ids=["big", "little"],
)
def test_the_recording_control_of_wavefront_gets_no_reply(
    client: ScriptedClient, start: bytes, stop: bytes
) -> None:
    assert client.send(start, DATA) == []
    assert client.session.is_recording
    assert client.send(stop, DATA) == []
    assert not client.session.is_recording


@pytest.mark.parametrize("extra", [b"\n", b"\0", b"\r\n\0"])
def test_bytes_after_the_recording_control_are_ignored(client: ScriptedClient, extra: bytes) -> None:
    assert client.send(START_BIG + extra, DATA) == []
    assert client.session.is_recording
    assert client.send(START_LITTLE[:28] + bytes(4) + START_LITTLE[32:] + extra, DATA) == []
    assert not client.session.is_recording


@pytest.mark.parametrize("end", [b"", b"\n", b"\0"])
@pytest.mark.parametrize("start", [b"Recording Start,file=C:\\My takes\\A b.c3d", b"recording start"])
def test_a_recording_is_started_and_stopped_by_commands(
    client: ScriptedClient, start: bytes, end: bytes
) -> None:
    """Field note 18."""
    assert client.send(start + end) == [(COMMAND, b"OK-" + start)]
    assert client.session.is_recording
    assert client.send(b"Recording Stop" + end) == [(COMMAND, b"OK-Recording Stop")]
    assert not client.session.is_recording


@pytest.mark.parametrize(
    "sent", [b"Recording", b"Recording Pause", b"Recording Started", b"Recording Stopped"]
)
def test_other_recording_commands_are_refused(client: ScriptedClient, sent: bytes) -> None:
    [(packet_type, text)] = client.send(sent)
    assert packet_type == ERROR
    assert text.startswith(b"Error-Recording takes Start or Stop")
    assert not client.session.is_recording


@pytest.mark.parametrize(
    "body",
    [
        b"",
        START_BIG[:-1],
        START_BIG[:12] + bytes(4) + START_BIG[16:],  # frame number 0
        START_BIG[:12] + b"\0\0\0\1" + START_BIG[16:],  # frame number 1
        START_BIG[:31] + b"\x02" + START_BIG[32:],  # event 2
        bytes(4),  # no component
    ],
    ids=["nothing", "cut short", "frame 0", "frame 1", "event 2", "no component"],
)
def test_other_data_frames_from_a_client_get_an_error(client: ScriptedClient, body: bytes) -> None:
    [(packet_type, text)] = client.send(body, DATA)

    assert packet_type == ERROR
    assert b"data frame" in text
    assert not client.session.is_recording


def test_the_reply_to_send_parameters_is_xml_with_the_requested_sections(client: ScriptedClient) -> None:
    [(packet_type, xml)] = client.send("SendParameters 3d General")

    parameters = parse_parameters(xml).parameters
    assert packet_type == XML
    assert parameters.general is not None
    assert parameters.general.name == "server under test"
    assert parameters.markers == client.scene.parameters.markers
    assert parameters.events is None


@pytest.mark.parametrize("sent", ["SendParameters", "SendParameters All\0"])
def test_all_sections_are_sent_by_default(client: ScriptedClient, sent: str) -> None:
    [(_, xml)] = client.send(sent)

    parameters = parse_parameters(xml).parameters
    assert None not in (parameters.general, parameters.markers, parameters.events)
