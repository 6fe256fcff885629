"""From the session to the fan-out: when each frame was captured, how late it is, whether it is skipped."""

from collections.abc import Callable, Collection
from typing import Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.encode import Stamp
from gateway.rtc3d.commands import Frequency
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.session.backlog import MAX_TOGETHER
from gateway.session.missing_frames import MissingFrames
from gateway.session.plan import MAX_HALVINGS, LagControl
from gateway.session.process_clock import running_clock
from gateway.session.rate_check import Arrivals
from gateway.session.status import FRAME_REJECTED, StreamStatus

Publish = Callable[[RawFrame, Stamp, frozenset[ComponentType]], None]
"""Takes a frame, its stamp, and the types of the components to publish."""

Skip = Callable[[RawFrame, Stamp, frozenset[ComponentType]], int]
"""Takes the same for components that are not published; returns how many messages this loses."""

_LEARNING_US: Final = 3_000_000
"""If there is no clock after this time, the server's time stamps are not those of one."""

_EVENT: Final = ComponentType.EVENT
"""Saves looking it up for every frame, which would take 0.1 µs."""

_EVENTS: Final = frozenset({_EVENT})


class Ingest:
    """Takes the frames of one session, in the batches in which they arrive from the network.

    It calls ``on_lateness`` with the number of halvings that LagControl decides on whenever that changes, and
    ``on_restart`` when the server's frame numbers or time stamps start again within the session.
    """

    _wanted: frozenset[ComponentType]
    _wanted_events: frozenset[ComponentType]
    _skippable: frozenset[ComponentType]
    _layout: FrameLayout | None  # of the newest frame; None before the first, and after a change of _wanted

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        publish: Publish,
        skip: Skip,
        on_lateness: Callable[[int], None],
        on_restart: Callable[[], None],
    ) -> None:
        self._skips_late_frames = stream.backlog == "latest"
        self._status = status
        self._publish = publish
        self._skip = skip
        self._on_lateness = on_lateness
        self._on_restart = on_restart
        self._clock = status.clock  # outlives the session
        self._clock.begin_connection()
        self._followed_type: ComponentType | None = None
        self._frame_number = 0  # the newest of a component of _followed_type, like the time stamp
        self._timestamp_us = 0
        self._num_followed = 0  # how many frames began with a component of _followed_type
        # With Frequency:n the server chooses the frames, so that gaps in the numbers are normal.
        self._counts_gaps = not isinstance(stream.rate, Frequency)
        self._numbers = MissingFrames()
        self._num_state_changes = status.num_state_changes
        self._lag = LagControl(source.max_lag_ms / 1000, MAX_HALVINGS if stream.adapt_rate else 1)
        self._num_restarts = 0  # how often time stamps or frame numbers started again in this session
        self._began_us: int | None = None  # when the first frame of this session arrived, on the steady clock
        self._num_skippable = 0  # how many components of the newest frame are wanted and no events
        self._unwanted = ""  # the components of the newest frame, if none of them is wanted
        self.want(stream.components)

    def want(self, components: Collection[ComponentType]) -> None:
        """Publish these components from now on."""
        self._wanted = frozenset(components)
        self._wanted_events = self._wanted & _EVENTS
        self._skippable = self._wanted - _EVENTS
        self._layout = None

    @property
    def arrivals(self) -> Arrivals:
        """What has arrived so far."""
        components = () if self._layout is None else self._layout.components
        rejected = self._status.losses.frames(FRAME_REJECTED)
        return Arrivals(
            self._status.frames_in + rejected,
            self._followed_type,
            self._num_followed,
            self._timestamp_us,
            frozenset([component.type for component in components]),
            self._num_restarts,
        )

    def receive(self, frames: list[RawFrame], utime: int, steady_us: int) -> None:
        """Take frames that arrived together, oldest first.

        ``utime`` is when they arrived, in µs since the Unix epoch; ``steady_us`` is the same moment on the
        steady clock (see HostClock). While frames are late, ``backlog: latest`` publishes the newest of each
        component and all events, and counts the rest as skipped. Usually that is the newest frame, but
        servers leave out components that are empty (field note 5), or send empty frames. If the server's
        time stamps are not those of a clock, frames are late if more than MAX_TOGETHER arrive together.
        """
        status = self._status
        status.frames_in += len(frames)
        status.last_frame_utime = utime
        if status.num_state_changes != self._num_state_changes:
            self._num_state_changes = status.num_state_changes
            self._numbers.interrupt()
        newest: list[frozenset[ComponentType]] | None = None
        has_wanted = False
        for index, frame in enumerate(frames):
            if frame.layout is not self._layout:
                self._set_layout(frame.layout)
            has_wanted = has_wanted or not self._unwanted
            if frame.layout.unknown_types:
                status.unknown_components_skipped(frame.layout.unknown_types)
            if not frame.layout.components:
                continue
            stamp = self._stamp(frame, utime, steady_us)
            if self._skips_late_frames and index < len(frames) - 1 and self._is_late(len(frames), steady_us):
                if newest is None:
                    newest = self._newest_components(frames)
                self._publish_newest(frame, stamp, newest[index])
            else:
                self._publish(frame, stamp, self._wanted)
        unwanted = "" if has_wanted else self._unwanted
        if unwanted != status.unwanted_components:
            status.components_received(unwanted)

    def _is_late(self, num_together: int, steady_us: int) -> bool:
        """Return whether the frame that was stamped last is late; ``num_together`` arrived with it."""
        if self._clock.has_clock:
            return self._lag.is_late
        is_learning = self._began_us is None or steady_us - self._began_us < _LEARNING_US
        return num_together > MAX_TOGETHER and not is_learning

    def _newest_components(self, frames: list[RawFrame]) -> list[frozenset[ComponentType]]:
        """Return the wanted components of each frame that no later one of these frames has."""
        later: frozenset[ComponentType] = frozenset()
        newest = []
        for frame in reversed(frames):
            types = self._wanted.intersection([component.type for component in frame.layout.components])
            newest.append(types - later)
            later |= types
        newest.reverse()
        return newest

    def _publish_newest(self, frame: RawFrame, stamp: Stamp, newest: frozenset[ComponentType]) -> None:
        """Publish the events and the ``newest`` components of a late frame; skip the others."""
        published, skipped = self._wanted_events, self._skippable
        if newest:
            published, skipped = published | newest, skipped - newest
        self._publish(frame, stamp, published)
        if num_lost := self._skip(frame, stamp, skipped):
            self._status.frame_skipped(num_lost)

    def _set_layout(self, layout: FrameLayout) -> None:
        types = [component.type for component in layout.components]
        self._layout = layout
        self._num_skippable = len(self._skippable.intersection(types))
        self._unwanted = ""
        if self._wanted.isdisjoint(types):
            self._unwanted = " ".join(each.key for each in types) or "nothing"
        if layout.num_extra_bytes:
            self._status.add_limitation("bytes after the last component of a frame are ignored")

    def _stamp(self, frame: RawFrame, utime: int, steady_us: int) -> Stamp:
        """Return the times of a frame, with the session; count and report what its numbers and times show."""
        status, clock, numbers = self._status, self._clock, self._numbers
        frame_number, timestamp_us = frame.number_and_timestamp
        first_type, followed = frame.layout.first_component_type, self._followed_type
        # Servers may number each type separately, so only one is followed: the first type that arrives, or
        # the first after it if that was the event type.
        if first_type is followed or followed is None or followed is _EVENT:
            self._followed_type = followed = first_type
            self._frame_number = frame_number
            self._timestamp_us = timestamp_us
            self._num_followed += 1
        capture_us, lag_s, restarted = clock.observe(timestamp_us, self._frame_number, steady_us)
        if self._counts_gaps and self._num_skippable:
            if first_type is not followed or first_type is _EVENT:
                numbers.interrupt()  # this frame has no number of the followed type
            elif num_missing := numbers.observe(frame_number, timestamp_us):
                held_up_s = running_clock().longest_delay_s()
                status.frames_unsent(num_missing, num_missing * self._num_skippable, held_up_s)
        if restarted:
            numbers.interrupt()
            self._lag.restart()
            self._num_restarts += 1
            # A server that restarts loses its connections. Within one, a file starts again, or a measurement.
            if self._began_us is None:
                status.restarts += 1  # the handshake has just been done
            else:
                self._on_restart()
        elif clock.has_clock:
            status.lag_s = lag_s
            if self._lag.observe(steady_us * 1e-6, lag_s):
                self._on_lateness(self._lag.halvings)
        if self._began_us is None:
            self._began_us = steady_us
        return Stamp(
            utime,
            capture_us + (utime - steady_us),
            status.session,
            status.parameters_version,
            clock.has_clock,
        )
