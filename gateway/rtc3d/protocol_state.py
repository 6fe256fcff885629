"""The states of a client's connection to an RT server, and every transition between them.

This is the only transition table in the gateway: the state of a stream is derived from it.
"""

from enum import Enum
from typing import Final


class ProtocolState(Enum):
    """What the client has requested, and what the server last sent."""

    IDLE = "idle"
    REQUESTED = "requested"  # StreamFrames was sent; neither a frame nor No Data has arrived yet
    STREAMING = "streaming"
    NO_MEASUREMENT = "no measurement"
    CLOSING = "closing"  # Bye was sent
    CLOSED = "closed"


class ProtocolInput(Enum):
    """What can change the state of a connection."""

    REQUEST_SENT = "StreamFrames sent"
    REQUEST_REFUSED = "StreamFrames refused"
    STOP_SENT = "StreamFrames Stop sent"
    FRAME_RECEIVED = "a frame received"
    NO_DATA_RECEIVED = "No Data received"
    BYE_SENT = "Bye sent"
    CONNECTION_ENDED = "the connection ended"


_TRANSITIONS: Final[dict[tuple[ProtocolState, ProtocolInput], ProtocolState]] = {
    (ProtocolState.IDLE, ProtocolInput.REQUEST_SENT): ProtocolState.REQUESTED,
    (ProtocolState.REQUESTED, ProtocolInput.REQUEST_REFUSED): ProtocolState.IDLE,
    (ProtocolState.REQUESTED, ProtocolInput.FRAME_RECEIVED): ProtocolState.STREAMING,
    (ProtocolState.REQUESTED, ProtocolInput.NO_DATA_RECEIVED): ProtocolState.NO_MEASUREMENT,
    (ProtocolState.STREAMING, ProtocolInput.NO_DATA_RECEIVED): ProtocolState.NO_MEASUREMENT,
    (ProtocolState.NO_MEASUREMENT, ProtocolInput.FRAME_RECEIVED): ProtocolState.STREAMING,
    (ProtocolState.REQUESTED, ProtocolInput.STOP_SENT): ProtocolState.IDLE,
    (ProtocolState.STREAMING, ProtocolInput.STOP_SENT): ProtocolState.IDLE,
    (ProtocolState.NO_MEASUREMENT, ProtocolInput.STOP_SENT): ProtocolState.IDLE,
    (ProtocolState.IDLE, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.REQUESTED, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.STREAMING, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.NO_MEASUREMENT, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    **{(state, ProtocolInput.CONNECTION_ENDED): ProtocolState.CLOSED for state in ProtocolState},
}


def next_state(state: ProtocolState, event: ProtocolInput) -> ProtocolState:
    """Return the state that follows ``state``; an input that the table lacks does not change it."""
    return _TRANSITIONS.get((state, event), state)
