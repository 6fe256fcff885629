"""The status of one stream: its state, its counters, and what went wrong."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from gateway.errors import DefectError, LinkError
from gateway.messages.host_time import now_utime
from gateway.rtc3d.client_protocol import ProtocolState
from gateway.runtime.failures import HOLD_S, DefectLog, EventLog, FailureLog, defect_text
from gateway.runtime.losses import Losses
from gateway.runtime.safe_text import safe_text
from gateway.session.clock import ServerClock
from gateway.session.state import Phase, StreamState, stream_state

MAX_ERROR_LENGTH: Final = 500
"""Longer error texts are cut: they may quote a server, and every status message contains the last one."""

MAX_LIMITATIONS: Final = 20
"""How many limitations of a connection are kept, and how many logged ones are remembered."""

MAX_UNKNOWN_TYPES: Final = 8
"""How many types that §7.2 does not define are listed for a connection."""

_LATE_BEFORE_A_GAP_S: Final = 0.5
"""A server that nobody reads from leaves out frames only when buffers are full: after this long at least."""

_MAX_REPAIRS: Final = 3
"""How many repairs of the parameters are logged; the others are counted."""

SKIPPED: Final = "skipped while behind"
"""The cause under which late frames that ``backlog: latest`` skips are counted."""

FRAME_REJECTED: Final = "frame rejected"
"""The cause under which frames that contradict themselves are counted."""

NOT_SENT: Final = "not sent by the server"
"""The cause under which frames that the server numbered and did not send are counted."""

_CONNECTING: Final = (StreamState.CONNECTING, StreamState.HANDSHAKING)
_RECEIVING: Final = (StreamState.STREAMING, StreamState.NO_MEASUREMENT)

_PROTOCOL_EVENTS: Final = {
    ProtocolState.STREAMING: "a frame arrived",
    ProtocolState.NO_MEASUREMENT: "the server reports that no measurement runs",
    ProtocolState.IDLE: "the server does not answer StreamFrames Stop, or refuses StreamFrames",
    ProtocolState.STOPPED: "the gateway stopped the frames",
}
"""Why the protocol entered a state, for the log."""

logger = logging.getLogger(__name__)


class SessionNumbers:
    """Numbers the connections of a source. All of its streams share it, so that no number occurs twice."""

    def __init__(self, newest: int = 0) -> None:
        self.newest = newest

    def next_after(self, session: int) -> int:
        """Return a number larger than ``session`` and than all numbers so far."""
        self.newest = max(self.newest, session) + 1
        return self.newest


class SourceWarnings:
    """What the streams of a source share, so that a WARNING that concerns several of them is logged once.

    ``subject`` begins those about late frames.
    """

    def __init__(self, subject: object) -> None:
        self.newest_losses_s: dict[str, float] = {}
        """When something was lost last on any of the streams, by cause."""
        self.logged: deque[str] = deque(maxlen=MAX_LIMITATIONS)
        """The limitations and repairs that were logged."""
        self._lateness = FailureLog(logger, subject)
        self._late: set[int] = set()

    def failed(self, stream: int, text: str) -> None:
        """Log that frames are late: as WARNING unless those of another stream are late already."""
        self._late.add(stream)
        self._lateness.failed(text)

    def in_time(self, stream: int, text: str) -> None:
        """Note that no frames of a stream are late any more; log it if that is so for all streams."""
        self._late.discard(stream)
        if not self._late:
            self._lateness.recovered(text)


@dataclass
class StreamStatus:
    """The status of one stream, over all its connections.

    What only has to be counted or noted is assigned to the fields. If more follows from an event, there is a
    method, which is named after it.
    """

    components: str
    """The stream's components, separated by spaces."""
    name: str = ""
    """Begins the stream's log lines."""
    on_state: Callable[[StreamState], None] = lambda _former: None
    """Called after each change of ``state``, with the former one."""
    state: StreamState = StreamState.WAITING
    """Derived from the connection and the protocol; see ``stream_state``."""
    byte_order: str = ""
    """The byte order of the server's frames, big or little; "" while it is unknown."""
    rate: str = ""
    """The rate that the server has accepted; "" for its default, or while it does not stream."""
    num_state_changes: int = 0
    """Grows with every change of ``state``."""
    session: int = 0
    """The number of the newest connection, in every message."""
    parameters_version: int = 0
    """The version of the server's parameters, 0 before the first; all streams of a source have the same."""
    sessions: SessionNumbers = field(default_factory=SessionNumbers)
    """Numbers the connections of all streams of the source."""
    frames_in: int = 0
    """The frames that have arrived, whether they are published or skipped."""
    last_frame_utime: int = 0
    """When the newest frame arrived, in µs since the Unix epoch; 0 before the first."""
    last_frame_s: float | None = None
    """The same on the running clock (gateway.session.process_clock); None before the first."""
    bytes_in: int = 0
    """The bytes that have arrived."""
    connections: int = 0
    """How many connections were opened."""
    tries: int = 0
    """The attempts to connect since the last completed handshake."""
    reconnects: int = 0
    """All attempts to connect except the first."""
    restarts: int = 0
    """How often a new connection showed that the server had restarted: its time stamps do not continue."""
    lag_s: float = 0.0
    """How late the newest frame was; see ServerClock.observe."""
    clock: ServerClock = field(default_factory=ServerClock)
    """The model of the server's clock, which Ingest updates with every frame."""
    unwanted_components: str = ""
    """The components of the newest frame if it had none of this stream's."""
    unwanted_since_s: float = 0.0
    """When the first of these frames arrived, on the running clock."""
    losses: Losses = field(init=False)
    """Counts by cause what was lost before any output."""
    limitations: list[str] = field(default_factory=list)
    """What the current connection lacks."""
    last_error: str = ""
    """The newest error, at most MAX_ERROR_LENGTH characters; "" if there was none."""
    last_error_utime: int = 0
    """When it happened, in µs since the Unix epoch."""
    last_error_s: float = -math.inf
    """The same on the monotonic clock."""
    known_defects: DefectLog | None = None
    """The defects of the source that are logged already."""
    warnings: SourceWarnings | None = None
    """What the streams of the source log together."""
    events: EventLog = field(init=False)
    """Logs what the server can cause again and again."""
    _phase: Phase = field(default=Phase.WAITING, init=False)
    _failures: FailureLog = field(init=False)
    _defects: DefectLog = field(init=False)
    _unknown_types: set[int] = field(default_factory=set, init=False)  # of this connection, those listed
    _unknown_text: str = field(default_factory=str, init=False)  # compiled, a default would not be assigned
    _warnings: SourceWarnings = field(init=False)
    _logged_request: str = field(init=False)

    def __post_init__(self) -> None:
        """Create the logs of losses, lost connections, defects and other events."""
        self.events = EventLog(logger, self)
        self._warnings = self.warnings or SourceWarnings(self)
        self._failures = FailureLog(logger, self, HOLD_S)
        self._defects = DefectLog(logger, self, self.known_defects)
        self.losses = Losses(logger, self, newest_by_cause_s=self._warnings.newest_losses_s)
        self._logged_request = ""  # here, because mypyc ignores the default of a field that __init__ lacks

    def __str__(self) -> str:
        """Return the name, which begins log messages."""
        return self.name

    # Reports of session and supervisor about the connection.

    def connecting(self, server: str) -> None:
        """Count an attempt to connect."""
        self.tries += 1
        self.enter(Phase.CONNECTING, "connecting", server)

    def connected(self, server: str) -> None:
        """Count a new session, and forget what was agreed in the previous one."""
        self.session = self.sessions.next_after(self.session)
        self.connections += 1
        self.limitations.clear()
        self._unknown_types.clear()
        self.byte_order = self.rate = ""
        self.enter(Phase.HANDSHAKING, "connected", server)

    def handshake_done(self, protocol_state: ProtocolState, server: str, request: str) -> None:
        """Note that the server accepted ``request``, a StreamFrames; frames may have arrived already."""
        self.tries = 0
        text = f"connected to {server}, which accepted {request}"
        if self._failures.failing and text == self._logged_request:
            logger.debug("%s: %s", self.name, text)
        else:
            self._logged_request = text
            self.events.log(logging.INFO, text, "connected")
        self._phase = Phase.READY
        self._update_state(protocol_state, "handshake done", server)

    def protocol_changed(self, protocol_state: ProtocolState, byte_order: str, server: str) -> None:
        """Note the new state of the protocol; ``byte_order`` is empty while it is unknown."""
        self.byte_order = byte_order
        self._update_state(protocol_state, _PROTOCOL_EVENTS.get(protocol_state, "frames requested"), server)

    def disconnected(self, error: LinkError) -> None:
        """Note and log why the connection ended or could not be opened."""
        self.record_error(str(error))
        if isinstance(error, DefectError):
            self._defects.log(error.__cause__ or error, str(error))
        else:
            self._failures.failed(str(error))
        self.enter(Phase.WAITING, "the connection ended", str(error))

    def defect(self, defect: Exception) -> None:
        """Log a defect that ends no connection."""
        self.record_error(defect_text(defect))
        self._defects.log(defect)

    def check(self) -> None:
        """Log recoveries that have held for long enough. Call it once a second."""
        if self.state in _RECEIVING:
            self._failures.recovered(f"{self.state.value} again")
        self.losses.check()

    # Reports about arriving data.

    def components_received(self, unwanted: str) -> None:
        """Note whether the frames of one read had a component of this stream.

        If not, ``unwanted`` are the components of the newest one.
        """
        if unwanted and not self.unwanted_components:
            self.unwanted_since_s = self.last_frame_s or 0.0
        self.unwanted_components = unwanted

    def frame_rejected(self, error: str, num_messages: int) -> None:
        """Count a frame that contradicts itself and would have had ``num_messages`` wanted components."""
        text = f"frame rejected: {error}"
        self.losses.lost(FRAME_REJECTED, text, messages=num_messages)
        self.record_error(text)

    def frame_skipped(self, num_messages: int) -> None:
        """Count a frame of which only the events are published, because frames are late."""
        self.losses.lost(
            SKIPPED,
            "frames arrive late and are skipped, except for the newest one (backlog: latest)",
            messages=num_messages,
        )

    def frames_late(self, lag_s: float, held_up_s: float, request: str = "") -> None:
        """Log that frames are late; ``request`` is what the server was asked for.

        ``held_up_s`` is how long the event loop of this gateway did not run lately.
        """
        text = f"frames arrive {1000 * lag_s:.0f} ms late"
        if request:
            text = f"frames arrive {1000 * lag_s:.0f} ms late; {request}"
        if held_up_s >= lag_s / 2:
            text = f"{text}; this gateway did not run for {held_up_s:.1f} s: check the load of this computer"
        self._warnings.failed(id(self), text)

    def frames_in_time(self, request: str = "") -> None:
        """Log that frames are no longer late; ``request`` is as in ``frames_late``."""
        self._warnings.in_time(id(self), f"frames arrive in time again{request}")

    def frames_unsent(self, num_frames: int, num_messages: int, held_up_s: float) -> None:
        """Count frames that the server numbered and did not send.

        A server leaves out frames if nobody takes those before: ``held_up_s`` is how long this gateway did
        not run lately. Frames that waited elsewhere are late.
        """
        if held_up_s >= _LATE_BEFORE_A_GAP_S:
            reason = (
                f"this gateway did not run for {held_up_s:.1f} s, and did not take those before; "
                "check the load of this computer"
            )
        elif self.clock.has_clock and self.lag_s >= _LATE_BEFORE_A_GAP_S:
            reason = (
                f"those before arrived {self.lag_s:.1f} s late, although this gateway was running; "
                "check the network, then the load of both computers"
            )
        else:
            reason = "this gateway was running and read those before; check the load of the server's computer"
        self.losses.lost(
            NOT_SENT,
            f"the server did not send {num_frames} of the frames that it numbered; {reason}",
            messages=num_messages,
            frames=num_frames,
        )

    def unknown_components_skipped(self, types: Sequence[int]) -> None:
        """Count components of one frame whose types §7.2 does not define."""
        if not self._unknown_types.issuperset(types):
            new = sorted(set(types) - self._unknown_types)
            # The server determines how many types there are, so up to MAX_UNKNOWN_TYPES are listed.
            num_listed = MAX_UNKNOWN_TYPES - len(self._unknown_types)
            self._unknown_types.update(new[:num_listed])
            further = " and others" if len(new) > num_listed else ""
            if self._unknown_text in self.limitations:
                self.limitations.remove(self._unknown_text)
            self._unknown_text = (
                f"components of unknown type {sorted(self._unknown_types)}{further} are skipped"
            )
            self._list_limitation(self._unknown_text)
        self.losses.lost("unknown component", self._unknown_text, messages=len(types))

    def file_lost(self, text: str) -> None:
        """Count a C3D file that the server sent and that is not stored."""
        self.losses.lost("C3D file", text, frames=0, level=logging.ERROR)

    # What the server and the gateway agreed on, and errors.

    def parameters_repaired(self, repairs: Sequence[str]) -> None:
        """Log what was repaired in the server's parameters, once for each text unless there are many."""
        rest = f"; and {len(repairs) - _MAX_REPAIRS} more" if len(repairs) > _MAX_REPAIRS else ""
        text = f"parameters repaired: {'; '.join(repairs[:_MAX_REPAIRS])}{rest}"
        if text not in self._warnings.logged:
            self._warnings.logged.append(text)
            self.events.log(logging.INFO, text, "parameters repaired")

    def add_limitation(self, text: str) -> None:
        """Add something that the current connection lacks, unless there are MAX_LIMITATIONS already.

        Each text is logged as WARNING once, and as DEBUG if a later connection has the same limitation.
        """
        text = safe_text(text)  # it may quote the server
        if not self._list_limitation(text):
            return
        if text in self._warnings.logged:
            logger.debug("%s: %s", self.name, text)
        else:
            self._warnings.logged.append(text)
            self.events.log(logging.WARNING, text, "limitation", MAX_LIMITATIONS)

    def _list_limitation(self, text: str) -> bool:
        """Add ``text`` to the limitations and return True, unless it is there or there are too many."""
        if text in self.limitations or len(self.limitations) >= MAX_LIMITATIONS:
            return False
        self.limitations.append(text)
        return True

    def replace_limitation(self, former: str, text: str) -> None:
        """Remove the limitation ``former`` and add ``text``; "" means none."""
        if former != text and former in self.limitations:
            self.limitations.remove(former)
        if text:
            self.add_limitation(text)

    def record_error(self, text: str) -> None:
        """Keep ``text``, cut to MAX_ERROR_LENGTH, as the last error, with the time."""
        self.last_error = safe_text(text, MAX_ERROR_LENGTH)
        self.last_error_utime = now_utime()
        self.last_error_s = time.monotonic()

    def enter(self, phase: Phase, event: str, cause: str) -> None:
        """Enter a phase in which earlier frames or No Data from the server do not matter."""
        self._phase = phase
        if phase is Phase.WAITING:
            self._warnings.in_time(id(self), "the connection with late frames has ended")
        self._update_state(ProtocolState.IDLE, event, cause)

    def _update_state(self, protocol_state: ProtocolState, event: str, cause: str) -> None:
        """Derive the state; if it changed, log the change with its cause and call ``on_state``."""
        before, self.state = self.state, stream_state(self._phase, protocol_state)
        if self.state is before:
            return
        self.num_state_changes += 1
        # Up to the end of the handshake, these states alternate while a server is away. After a failure, all
        # of them may alternate; ``check`` logs when this is over.
        is_attempt = self.state in _CONNECTING or (before in _CONNECTING and self.state not in _RECEIVING)
        text = f"{before.value} → {self.state.value}: {event} ({cause})"
        if is_attempt or self._failures.failing:
            logger.debug("%s: %s", self.name, text)
        else:
            self.events.log(logging.INFO, text, f"{before.value} → {self.state.value}")
        try:
            self.on_state(before)
        except Exception as defect:  # noqa: BLE001 - what shows the state must not stop the stream
            self.defect(defect)
