"""The complete rule for the state of a stream: each phase with each protocol state."""

import pytest

from gateway.rtc3d.protocol_state import ProtocolState
from gateway.stream.state import Phase, StreamState, stream_state

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


def test_every_state_can_be_reached() -> None:
    assert {stream_state(phase, state) for phase in Phase for state in ProtocolState} == set(StreamState)
