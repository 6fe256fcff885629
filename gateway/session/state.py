"""The state of a stream, and the rule that derives it."""

from enum import Enum
from typing import Final

from gateway.rtc3d.client_protocol import ProtocolState


class Phase(Enum):
    """The phases in the life of a connection."""

    WAITING = "waiting"  # no connection; the next attempt follows after a delay
    CONNECTING = "connecting"
    HANDSHAKING = "handshaking"
    READY = "ready"
    SILENT = "silent"  # a measurement runs and no frame arrives: the connection is about to be closed


class StreamState(Enum):
    """The states of a stream. The values appear in logs, status messages and metrics."""

    CONNECTING = "connecting"
    HANDSHAKING = "handshaking"
    IDLE = "idle"  # connected; frames are not requested, or neither a frame nor No Data has arrived yet
    NO_MEASUREMENT = "no measurement"
    STREAMING = "streaming"
    STALLED = "stalled"  # a measurement runs and no frame arrives
    WAITING = "waiting to reconnect"


_BY_PHASE: Final = {
    Phase.WAITING: StreamState.WAITING,
    Phase.CONNECTING: StreamState.CONNECTING,
    Phase.HANDSHAKING: StreamState.HANDSHAKING,
    Phase.READY: StreamState.IDLE,
    Phase.SILENT: StreamState.STALLED,
}


def stream_state(phase: Phase, protocol_state: ProtocolState) -> StreamState:
    """Return the state of a stream.

    It follows from two inputs, and each has one owner. ``phase`` is the phase of the connection, which
    session and supervisor report. ``protocol_state`` says what was requested and what the server sends; it
    belongs to the connection's ClientProtocol.

    - While the connection is usable, frames or No Data from the server decide. This includes the handshake,
      because a frame may arrive before StreamFrames is acknowledged (field note 3).
    - Otherwise the phase decides. A ready connection that receives neither is idle.
    """
    if phase in {Phase.HANDSHAKING, Phase.READY}:
        if protocol_state is ProtocolState.STREAMING:
            return StreamState.STREAMING
        if protocol_state is ProtocolState.NO_MEASUREMENT:
            return StreamState.NO_MEASUREMENT
    return _BY_PHASE[phase]
