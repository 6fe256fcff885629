"""What a stream is doing: every state and every change of it stand in one table, here."""

from enum import Enum
from typing import Final


class StreamState(Enum):
    """The states, as logs and status name them."""

    CONNECTING = "connecting"
    HANDSHAKING = "handshaking"
    IDLE = "idle"  # connected, no frames asked for, or nothing said about them yet
    NO_MEASUREMENT = "no measurement"
    STREAMING = "streaming"
    STALLED = "stalled"  # a measurement should run, and nothing comes
    WAITING = "waiting to reconnect"


class StreamInput(Enum):
    """What happens to a stream."""

    DIAL = "connecting"
    CONNECTED = "connected"
    READY = "handshake done"
    FRAME = "a frame came"
    NO_DATA = "the server says that no measurement runs"
    STOPPED = "stopped, because nobody listens"
    SILENCE = "silence"
    ENDED = "the connection ended"


_S, _I = StreamState, StreamInput

_TRANSITIONS: Final[dict[tuple[StreamState, StreamInput], StreamState]] = {
    (_S.WAITING, _I.DIAL): _S.CONNECTING,
    (_S.CONNECTING, _I.CONNECTED): _S.HANDSHAKING,
    # A frame may come before StreamFrames is acknowledged (field note 3); then READY changes nothing.
    (_S.HANDSHAKING, _I.READY): _S.IDLE,
    **{(state, _I.FRAME): _S.STREAMING for state in (_S.HANDSHAKING, _S.IDLE, _S.NO_MEASUREMENT, _S.STALLED)},
    **{
        (state, _I.NO_DATA): _S.NO_MEASUREMENT
        for state in (_S.HANDSHAKING, _S.IDLE, _S.STREAMING, _S.STALLED)
    },
    **{(state, _I.STOPPED): _S.IDLE for state in (_S.STREAMING, _S.NO_MEASUREMENT, _S.STALLED)},
    (_S.STREAMING, _I.SILENCE): _S.STALLED,
    **{(state, _I.ENDED): _S.WAITING for state in StreamState},
}


def next_state(state: StreamState, happened: StreamInput) -> StreamState:
    """Return the state after ``happened``; what the table does not have changes nothing."""
    return _TRANSITIONS.get((state, happened), state)
