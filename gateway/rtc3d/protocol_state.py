"""The states of a client's connection to an RT server, and every transition between them.

This is the only table of transitions in the gateway. The state of a stream is derived from these states.
"""

from enum import Enum
from typing import Final


class ProtocolState(Enum):
    """The states: what the client has requested, and what the server sends."""

    IDLE = "idle"  # the server has accepted no request for frames, as far as the client knows
    REQUESTED = "requested"  # StreamFrames was sent; neither a frame nor No Data has arrived yet
    STREAMING = "streaming"
    NO_MEASUREMENT = "no measurement"
    STOPPED = "stopped"  # the server accepted StreamFrames Stop; a frame that still arrives was under way
    CLOSING = "closing"  # Bye was sent
    CLOSED = "closed"


class ProtocolInput(Enum):
    """The inputs that can change the state of a connection."""

    REQUEST_SENT = "StreamFrames sent"
    REQUEST_REFUSED = "StreamFrames refused"
    STOP_ACCEPTED = "StreamFrames Stop accepted"
    STOP_UNANSWERED = "StreamFrames Stop not answered"
    FRAME_RECEIVED = "a frame received"
    NO_DATA_RECEIVED = "No Data received"
    BYE_SENT = "Bye sent"
    CONNECTION_ENDED = "the connection ended"


_TRANSITIONS: Final[dict[tuple[ProtocolState, ProtocolInput], ProtocolState]] = {
    (ProtocolState.IDLE, ProtocolInput.REQUEST_SENT): ProtocolState.REQUESTED,
    (ProtocolState.STOPPED, ProtocolInput.REQUEST_SENT): ProtocolState.REQUESTED,
    (ProtocolState.REQUESTED, ProtocolInput.REQUEST_REFUSED): ProtocolState.IDLE,
    # A reply does not always say what it answers (field note 20). What the server sends shows the truth: if
    # frames arrive although the server seems to have refused them, it has not.
    (ProtocolState.IDLE, ProtocolInput.FRAME_RECEIVED): ProtocolState.STREAMING,
    (ProtocolState.IDLE, ProtocolInput.NO_DATA_RECEIVED): ProtocolState.NO_MEASUREMENT,
    (ProtocolState.REQUESTED, ProtocolInput.FRAME_RECEIVED): ProtocolState.STREAMING,
    (ProtocolState.REQUESTED, ProtocolInput.NO_DATA_RECEIVED): ProtocolState.NO_MEASUREMENT,
    (ProtocolState.STREAMING, ProtocolInput.NO_DATA_RECEIVED): ProtocolState.NO_MEASUREMENT,
    (ProtocolState.NO_MEASUREMENT, ProtocolInput.FRAME_RECEIVED): ProtocolState.STREAMING,
    **{
        (state, stop): after
        for state in (
            ProtocolState.IDLE,
            ProtocolState.REQUESTED,
            ProtocolState.STREAMING,
            ProtocolState.NO_MEASUREMENT,
        )
        for stop, after in (
            (ProtocolInput.STOP_ACCEPTED, ProtocolState.STOPPED),
            (ProtocolInput.STOP_UNANSWERED, ProtocolState.IDLE),  # the next frame shows if it was ignored
        )
    },
    (ProtocolState.IDLE, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.REQUESTED, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.STREAMING, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.NO_MEASUREMENT, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    (ProtocolState.STOPPED, ProtocolInput.BYE_SENT): ProtocolState.CLOSING,
    **{(state, ProtocolInput.CONNECTION_ENDED): ProtocolState.CLOSED for state in ProtocolState},
}


def next_state(state: ProtocolState, protocol_input: ProtocolInput) -> ProtocolState:
    """Return the state after ``protocol_input``; an input that is not in the table changes nothing."""
    return _TRANSITIONS.get((state, protocol_input), state)
