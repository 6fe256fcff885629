"""The log of a session, word for word, from the handshake to frames that contradict themselves."""

import logging

import pytest

from gateway.errors import ClosedError, LinkError, PacketError
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.stream.source_warnings import SourceWarnings
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from tests.losses import amounts
from tests.servers import error, markers_frame, packet
from tests.unit.stream.scripted_server import obliging, refusing
from tests.unit.stream.session_lab import Lab
from tests.virtual_time import settle

SERVER = "192.0.2.20:3020"
TOO_SHORT = packet(3, b"\0\0\0")


@pytest.fixture(autouse=True)
def levels(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")


def logged(caplog: pytest.LogCaptureFixture, module: str) -> list[str]:
    return [
        f"{record.levelname} {record.getMessage()}"
        for record in caplog.records
        if record.name == f"gateway.stream.{module}"
    ]


async def session_with_frames() -> Lab:
    lab = Lab()
    await lab.streaming(1)
    return lab


async def test_each_state_from_connecting_to_streaming(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab()
    await lab.start()
    lab.connection.send_frames(1)
    lab.connection.send(packet(4))
    await lab.control.stop()
    assert logged(caplog, "status") == [
        f"DEBUG lab (3d): waiting to reconnect → connecting: connecting ({SERVER})",
        f"DEBUG lab (3d): connecting → handshaking: connected ({SERVER})",
        f"INFO lab (3d): connected to {SERVER}, which accepted StreamFrames AllFrames 3D",
        f"DEBUG lab (3d): handshaking → idle: handshake done ({SERVER})",
        f"INFO lab (3d): idle → streaming: a frame arrived ({SERVER})",
        f"INFO lab (3d): streaming → no measurement: the server reports that no measurement runs ({SERVER})",
        f"INFO lab (3d): no measurement → idle: the gateway stopped the frames ({SERVER})",
    ]


async def test_rejected_frames_are_a_warning_once_and_their_end_is_logged_with_the_total(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = await session_with_frames()
    caplog.clear()
    lab.connection.send(TOO_SHORT)
    lab.connection.send(TOO_SHORT)
    lab.connection.send_frames(2)
    lab.status.losses.close()
    first, end = (line for line in logged(caplog, "status") if "frame rejected" in line)
    text = "frame rejected: data frame of 3 bytes: too short for its component count"
    assert first == f"WARNING lab (3d): {text}"
    assert end == "INFO lab (3d): lost within 0.0 s: 2 messages of 2 frames (frame rejected)"
    assert amounts(lab.status.losses.report()) == {"frame rejected": (2, 2)}


async def test_frames_in_another_byte_order_are_a_limitation() -> None:
    lab = Lab()
    await lab.streaming()
    lab.connection.send(markers_frame(1, (0.0, 0.0, 0.0), order="<"))
    assert lab.status.byte_order == "little"
    assert lab.status.limitations == ["the server sends little-endian frames, not the byte order agreed"]


async def test_a_packet_that_answers_nothing_is_shown_with_at_most_200_characters(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = await session_with_frames()
    caplog.clear()
    lab.connection.send(error("x" * 201))
    lab.connection.send(packet(77, b"new"))
    assert logged(caplog, "session") == [
        f"DEBUG lab: unexpected packet of type 0: {'x' * 200}",
        "DEBUG lab: unexpected packet of type 77: new",
    ]


async def test_a_corrupt_stream_ends_the_session_with_its_cause() -> None:
    lab = await session_with_frames()
    lab.connection.send(b"HTTP/1.1 400 Bad Request\r\n")
    with pytest.raises(ClosedError) as caught:
        await lab.session.monitor(lab.check_silence)
    assert str(caught.value).startswith(f"{SERVER}: packet size 1213486160 (limit ")
    assert isinstance(caught.value.__cause__, PacketError)


async def test_bytes_after_the_end_change_no_state() -> None:
    lab = await session_with_frames()
    lab.connection.end()
    await settle()
    lab.status.disconnected(LinkError("the test"))
    state = lab.status.state
    lab.session.data_received(packet(4))
    assert lab.status.state is state


async def test_repairs_of_the_parameters_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    cells = "<The_3D><Frequency>fast</Frequency></The_3D>" * 2 + "<The_6D><Frequency>x</Frequency></The_6D>"
    xml = f"<RT_Parameters>{cells}<The_3D><Unit>m</The_3D></RT_Parameters>"
    repairs = parse_parameters(xml.encode()).recovered
    lab = Lab(lambda command: packet(2, xml) if command == "SendParameters" else obliging(command))
    await lab.start()
    assert len(repairs) > 3
    texts = "; ".join(repairs[:3])
    expected = f"INFO lab (3d): parameters repaired: {texts}; and {len(repairs) - 3} more"
    assert [line for line in logged(caplog, "status") if "repaired" in line] == [expected]
    lab.status.parameters_repaired(repairs)
    assert [line for line in logged(caplog, "status") if "repaired" in line] == [expected]


async def test_a_server_that_refuses_every_form_ends_the_handshake_with_what_to_check() -> None:
    lab = Lab(refusing("StreamFrames"))
    with pytest.raises(LinkError) as caught:
        await lab.start()
    text = "refuses StreamFrames in every form that the protocol has; check its real-time output settings"
    assert str(caught.value) == f"{SERVER} {text}"
    assert (lab.status.state, lab.status.tries) == (StreamState.HANDSHAKING, 1)


@pytest.mark.parametrize(
    ("held_up_s", "lag_s", "reason"),
    [
        (3.1, 0.02, "this gateway did not run for 3.1 s, and did not take those before"),
        (3.1, None, "this gateway did not run for 3.1 s, and did not take those before"),
        (0.06, 3.2, "those before arrived 3.2 s late, although this gateway was running; check the network"),
        (0.06, 0.02, "this gateway was running and read those before; check the load of the server's comp"),
        (0.06, None, "this gateway was running and read those before; check the load of the server's comp"),
    ],
)
def test_a_gap_says_whether_this_gateway_was_running(
    held_up_s: float, lag_s: float | None, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The gateway measures whether it could read; late frames alone do not show who caused a gap."""
    status = StreamStatus("3d", name="lab (3d)")
    for number in range(1000 if lag_s is not None else 0):
        status.clock.observe(10_000 * number, number, 10_000 * number)
    status.lag_measured(lag_s or 0.0)
    status.frames_unsent(100, 100, held_up_s)
    [text] = [message for message in caplog.messages if "did not send" in message]
    assert text.startswith(f"lab (3d): the server did not send 100 of the frames that it numbered; {reason}")


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_late_frames_are_one_line_for_all_streams_of_a_source(caplog: pytest.LogCaptureFixture) -> None:
    """A busy host delays all streams at once; a line for each says nothing more."""
    shared = SourceWarnings("lab")
    first, second, third = (StreamStatus(each, name=f"lab ({each})", warnings=shared) for each in "abc")
    first.frames_late(0.12, 0.0)
    second.frames_late(0.13, 0.0)
    third.frames_late(0.14, 0.0)
    assert warnings_of(caplog) == ["lab: frames arrive 120 ms late"]
    caplog.clear()
    first.frames_in_time()
    second.disconnected(LinkError("the test"))
    assert not [message for message in caplog.messages if "late" in message or "in time" in message]
    third.frames_in_time()
    [over] = [message for message in caplog.messages if "in time" in message]
    assert over.startswith("lab: frames arrive in time again, after ")
    caplog.clear()
    second.frames_late(2.0, 1.9)
    cause = "this gateway did not run for 1.9 s: check the load of this computer"
    assert warnings_of(caplog) == [f"lab: frames arrive 2000 ms late; {cause}"]


def test_a_limitation_that_all_streams_of_a_source_have_is_one_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each stream opens a session with the same server, which refuses the same commands in each."""
    shared = SourceWarnings("lab")
    for name in ("lab (3d)", "lab (analog)"):
        status = StreamStatus("3d", name=name, warnings=shared)
        status.add_limitation("the server refused Version 1.0")
        assert status.limitations == ["the server refused Version 1.0"]
    assert warnings_of(caplog) == ["lab (3d): the server refused Version 1.0"]
