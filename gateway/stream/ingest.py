"""From received frames to the fan-out: when each was captured, how late it is, what is skipped."""

import logging
from collections.abc import Callable
from typing import Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame
from gateway.stream.rate_control import LagControl
from gateway.stream.status import StreamStatus

logger = logging.getLogger(__name__)

Publish = Callable[[Frame, Stamp, frozenset[ComponentType]], None]
"""Takes a frame, its times, and which of its components are to be published."""

_EVENTS: Final = frozenset({ComponentType.EVENT})


class Ingest:
    """Takes the frames of one session, in the batches in which they come from the network.

    ``on_lag`` is called with the number of halvings when the rate should change; ``on_restart`` when
    the server's frame numbers or time stamps begin anew within the session.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        publish: Publish,
        on_lag: Callable[[int], None],
        on_restart: Callable[[], None],
    ) -> None:
        self._source = source
        self._wanted = frozenset(stream.components)
        self._events = _EVENTS & self._wanted
        self.skips = stream.backlog == "latest"
        self._status = status
        self._publish = publish
        self._on_lag = on_lag
        self._on_restart = on_restart
        self._clock = status.clock  # outlives connections: it sees by itself when the server was restarted
        self._counted: ComponentType | None = None
        self._frame_number = 0  # of that component type
        self._lag = LagControl(source.max_lag_ms / 1000)

    def take(self, frames: list[Frame], utime: int, now_s: float) -> None:
        """Take frames that came together at ``utime``, oldest first; ``now_s`` is the monotonic clock's time.

        While they come late, only the newest of them is published whole; of the others the events are,
        which are never skipped, and the rest is counted.
        """
        status = self._status
        status.frames_in += len(frames)
        status.last_frame_utime = utime
        last = frames[-1]
        for frame in frames:
            if frame.layout.unknown_types:
                self._note_unknown(frame.layout.unknown_types)
            if not frame.layout.parts:
                continue
            stamp = self._stamp(frame, utime, now_s)
            if self._lag.behind and self.skips and frame is not last:
                status.drops["skipped while behind"] += 1
                self._publish(frame, stamp, self._events)
            else:
                self._publish(frame, stamp, self._wanted)

    def _stamp(self, frame: Frame, utime: int, now_s: float) -> Stamp:
        layout = frame.layout
        frame_number, timestamp_us = frame.number_and_time
        first = layout.first_type
        # Servers may count component types apart: one of them is followed, events only where nothing else is.
        if first is self._counted:
            self._frame_number = frame_number
        elif self._counted is None or self._counted is ComponentType.EVENT:
            self._counted = first
            self._frame_number = frame_number
        clock = self._clock
        capture_utime, lag_s, restarted = clock.observe(timestamp_us, self._frame_number, utime)
        if restarted:
            self._status.restarts += 1
            self._lag.restart()
            self._on_restart()
        elif clock.has_clock:
            self._status.lag_s = lag_s
            if self._lag.observe(now_s, lag_s):
                self._on_lag(self._lag.halvings)
        return Stamp(utime, capture_utime, self._status.session, clock.has_clock)

    def _note_unknown(self, types: tuple[int, ...]) -> None:
        self._status.drops["unknown component"] += len(types)
        text = f"components of unknown type {sorted(set(types))} are skipped"
        if self._status.limit(text):
            logger.warning("%s: %s", self._source.name, text)
