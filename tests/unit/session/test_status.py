"""The status of a stream: its state, errors, limitations and counts."""

import logging
from types import SimpleNamespace

import pytest

from gateway.errors import ClosedError, LinkError
from gateway.messages.host_time import now_utime
from gateway.rtc3d.client_protocol import ProtocolState
from gateway.session.state import Phase, StreamState, stream_state
from gateway.session.status import MAX_ERROR_LENGTH, MAX_LIMITATIONS, NOT_SENT, SourceWarnings, StreamStatus
from gateway.session.supervisor import FrameRate
from tests.support.errors import names
from tests.support.records import kinds
from tests.support.statuses import amounts

SERVER = "192.0.2.20:3020"


def logged(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [f"{record.levelname} {record.getMessage()}" for record in caplog.records]


def limited(status: StreamStatus, *texts: str) -> None:
    for text in texts:
        status.add_limitation(text)


def test_the_beginning_of_an_error_is_kept_with_its_time() -> None:
    status = StreamStatus("3d")
    before = now_utime()
    status.record_error("refused: " + 20_000_000 * "x")
    assert before <= status.last_error_utime <= now_utime()
    assert status.last_error.startswith("refused: xxx")
    assert len(status.last_error) == MAX_ERROR_LENGTH


def test_a_change_of_state_is_logged_with_source_states_and_cause(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    states: list[StreamState] = []
    status = StreamStatus("3d", name="lab (3d)", on_state=states.append)
    status.connecting(SERVER)
    status.connected(SERVER)
    status.handshake_done(ProtocolState.REQUESTED, SERVER, "StreamFrames")
    status.protocol_changed(ProtocolState.STREAMING, "big", SERVER)
    status.protocol_changed(ProtocolState.NO_MEASUREMENT, "big", SERVER)
    status.protocol_changed(ProtocolState.STOPPED, "big", SERVER)
    status.protocol_changed(ProtocolState.REQUESTED, "big", SERVER)  # still idle: logged once
    status.enter(Phase.SILENT, "silence", "no frame for 3 s")
    status.disconnected(ClosedError("closed by the test"))
    expected = [
        ["DEBUG", "waiting to reconnect → connecting", SERVER],
        ["DEBUG", "connecting → handshaking", SERVER],
        ["INFO", SERVER, "StreamFrames"],
        ["DEBUG", "handshaking → idle", SERVER],
        ["INFO", "idle → streaming", SERVER],
        ["INFO", "streaming → no measurement", SERVER],
        ["INFO", "no measurement → idle", SERVER],
        ["INFO", "idle → stalled", "no frame for 3 s"],
        ["WARNING", "closed by the test"],
        ["DEBUG", "stalled → waiting to reconnect", "closed by the test"],
    ]
    for line, values in zip(logged(caplog), expected, strict=True):
        assert names(line, "lab (3d)", *values), values
    assert status.last_error == "closed by the test"
    assert len(states) == 8
    assert (states[-1], status.state) == (StreamState.STALLED, StreamState.WAITING)


def test_a_defect_in_what_shows_the_state_is_an_error_once(caplog: pytest.LogCaptureFixture) -> None:
    def fail(_before: StreamState) -> None:
        raise ZeroDivisionError("by the test")

    status = StreamStatus("3d", name="lab (3d)", on_state=fail)
    status.connecting(SERVER)
    status.connected(SERVER)
    assert status.state is StreamState.HANDSHAKING
    [error] = caplog.records
    assert names(error.message, "lab (3d)", "ZeroDivisionError: by the test")
    assert error.levelname == "ERROR"
    assert error.exc_info is not None


def test_a_frame_may_arrive_before_the_handshake_is_done() -> None:
    status = StreamStatus("3d")
    status.connecting(SERVER)
    status.connected(SERVER)
    status.protocol_changed(ProtocolState.STREAMING, "little", SERVER)
    status.handshake_done(ProtocolState.STREAMING, SERVER, "StreamFrames")
    assert status.state is StreamState.STREAMING
    assert status.byte_order == "little"


def test_a_new_connection_counts_and_forgets_what_was_agreed() -> None:
    status = StreamStatus("3d", session=4, byte_order="little", rate="AllFrames", limitations=["no names"])
    status.connecting(SERVER)
    status.connected(SERVER)
    assert (status.session, status.byte_order, status.rate, status.limitations) == (5, "", "", [])
    assert status.tries == 1
    status.handshake_done(ProtocolState.IDLE, SERVER, "StreamFrames")
    assert status.tries == 0


def test_an_outage_is_a_warning_for_each_reason(caplog: pytest.LogCaptureFixture) -> None:
    """A server that froze and was then ended no longer lacks a reply: it refuses connections."""
    status = StreamStatus("3d", name="lab (3d)")
    for error in [
        "no reply to StreamFrames",
        "no reply within 2 s",
        "no reply within 4 s",
        "refused",
        "refused",
    ]:
        status.connecting(SERVER)
        status.disconnected(LinkError(error))
    warnings = [each for each in caplog.records if each.levelno == logging.WARNING]
    assert len(warnings) == 3


def test_a_limitation_is_a_warning_once_over_all_connections(caplog: pytest.LogCaptureFixture) -> None:
    status = StreamStatus("3d", name="lab (3d)")
    status.connected(SERVER)
    caplog.set_level(logging.DEBUG)
    limited(status, "no Version", "no Version")
    assert logged(caplog) == ["WARNING lab (3d): no Version"]
    caplog.clear()
    status.connected(SERVER)
    assert status.limitations == []
    limited(status, "no Version", "no names")
    assert logged(caplog)[-2:] == ["DEBUG lab (3d): no Version", "WARNING lab (3d): no names"]
    assert status.limitations == ["no Version", "no names"]


def test_limitations_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    status = StreamStatus("3d")
    limited(status, *(f"the server refused {number}" for number in range(100)))
    assert len(status.limitations) == len(caplog.records) == MAX_LIMITATIONS


@pytest.mark.interpreted
def test_the_frame_rate_is_exact_and_zero_if_no_time_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.0, 12.0, 13.0])
    monkeypatch.setattr("gateway.session.supervisor.time", SimpleNamespace(monotonic=clock.__next__))
    rate = FrameRate()
    assert [rate.update(frames) for frames in (100, 150, 170)] == [50.0, 0.0, 20.0]


def test_every_frame_that_is_lost_is_counted_by_its_cause() -> None:
    status = StreamStatus("3d")
    for _ in range(2):
        status.frame_rejected("too short", 5)
        status.frame_skipped(3)
        status.unknown_components_skipped((9, 9, 7))
        status.file_lost("the disk is full")
    assert amounts(status.losses.report()) == {
        "frame rejected": (10, 2),
        "skipped while behind": (6, 2),
        "unknown component": (6, 2),
        "C3D file": (2, 0),
    }
    assert status.last_error == "frame rejected: too short"
    [limitation] = status.limitations
    assert names(limitation, "[7, 9]")


def test_the_listed_types_of_unknown_components_are_bounded_and_one_limitation() -> None:
    status = StreamStatus("3d")
    status.add_limitation("another one\x1b")
    for first in range(100, 200, 5):
        status.unknown_components_skipped(tuple(range(first, first + 5)))
    text = "components of unknown type [100, 101, 102, 103, 104, 105, 106, 107] and others are skipped"
    assert status.limitations == [r"another one\x1b", text]
    status.connected(SERVER)
    status.unknown_components_skipped((6,))
    [limitation] = status.limitations
    assert names(limitation, "[6]")


def test_attempts_and_connections_are_added_up() -> None:
    status = StreamStatus("3d")
    for _ in range(2):
        status.connecting(SERVER)
        status.connected(SERVER)
        status.disconnected(ClosedError("closed by the server"))
    assert (status.tries, status.session, status.connections) == (2, 2, 2)


@pytest.mark.parametrize(
    ("held_up_s", "lag_s", "values"),
    [
        (3.1, 0.02, ["3.1 s", "this computer"]),
        (3.1, None, ["3.1 s", "this computer"]),
        (0.06, 3.2, ["3.2 s late", "both computers"]),
        (0.06, 0.02, ["server's computer"]),
        (0.06, None, ["server's computer"]),
    ],
)
def test_a_gap_says_whether_this_gateway_was_running(
    held_up_s: float, lag_s: float | None, values: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """The gateway measures whether it could read; late frames alone do not show who caused a gap."""
    status = StreamStatus("3d", name="lab (3d)")
    for number in range(1000 if lag_s is not None else 0):
        status.clock.observe(10_000 * number, number, 10_000 * number)
    status.lag_s = lag_s or 0.0
    status.frames_unsent(100, 100, held_up_s)
    assert kinds(caplog) == [("WARNING", NOT_SENT)]
    assert names(caplog.messages[-1], "lab (3d)", 100, *values)


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_late_frames_are_one_line_for_all_streams_of_a_source(caplog: pytest.LogCaptureFixture) -> None:
    """A busy host delays all streams at once; a line for each says nothing more."""
    caplog.set_level(logging.INFO)
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
    assert over.startswith("lab: ")
    caplog.clear()
    second.frames_late(2.0, 1.9)
    [warning] = warnings_of(caplog)
    assert names(warning, "lab", "2000 ms late", "1.9 s")


def test_a_limitation_that_all_streams_of_a_source_have_is_one_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each stream opens a session with the same server, which refuses the same commands in each."""
    shared = SourceWarnings("lab")
    for name in ("lab (3d)", "lab (analog)"):
        status = StreamStatus("3d", name=name, warnings=shared)
        status.add_limitation("a limitation")
        assert status.limitations == ["a limitation"]
    assert warnings_of(caplog) == ["lab (3d): a limitation"]


# --- the rule for the state


WITHOUT_CONNECTION = {
    Phase.WAITING: StreamState.WAITING,
    Phase.CONNECTING: StreamState.CONNECTING,
    Phase.SILENT: StreamState.STALLED,
}


@pytest.mark.parametrize("protocol_state", ProtocolState)
@pytest.mark.parametrize("phase", WITHOUT_CONNECTION)
def test_without_a_usable_connection_the_phase_decides(phase: Phase, protocol_state: ProtocolState) -> None:
    assert stream_state(phase, protocol_state) is WITHOUT_CONNECTION[phase]


@pytest.mark.parametrize("phase", [Phase.HANDSHAKING, Phase.READY])
def test_what_the_server_sends_decides_during_the_handshake_and_after_it(phase: Phase) -> None:
    assert stream_state(phase, ProtocolState.STREAMING) is StreamState.STREAMING
    assert stream_state(phase, ProtocolState.NO_MEASUREMENT) is StreamState.NO_MEASUREMENT


@pytest.mark.parametrize(
    "protocol_state",
    [ProtocolState.IDLE, ProtocolState.REQUESTED, ProtocolState.CLOSING, ProtocolState.CLOSED],
)
def test_a_connection_on_which_nothing_arrives_is_idle_after_its_handshake(
    protocol_state: ProtocolState,
) -> None:
    assert stream_state(Phase.HANDSHAKING, protocol_state) is StreamState.HANDSHAKING
    assert stream_state(Phase.READY, protocol_state) is StreamState.IDLE
