"""Observation of one stream: rates, message sizes, and which markers and tools are in view."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.encode import ITEMS_OFFSET
from gateway.messages.host_time import now_steady_us
from gateway.outputs.findings import MessageLoad
from gateway.rtc3d.commands import SendParameters
from gateway.rtc3d.components import WIRE_ORDER, Component, ComponentType, is_visible
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.runtime.workers import WorkerThread
from gateway.session.plan import StreamPlan, plan_streams
from gateway.session.process_clock import running_clock
from gateway.session.replies import Connection
from gateway.session.session import Session
from gateway.session.status import StreamStatus
from gateway.session.stream_requests import StreamRequests
from gateway.session.supervisor import component_keys, stream_name

COMPONENTS_WITH_VISIBILITY: Final = (ComponentType.MARKERS, ComponentType.TOOLS)
"""The components whose items can be out of view."""


class ObservedComponent:
    """Statistics of the frames of one component: number, times, size, and which items are in view.

    The frames were requested at ``requested_us`` on the steady clock.
    """

    def __init__(self, requested_us: int) -> None:
        self._requested_us = requested_us
        self._num_frames = 0
        self._largest_message_bytes = 0
        self._num_items = 0
        self._num_visible_items = 0
        self._was_visible: npt.NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._timestamps_us: list[int] = []
        self._first_us = self._last_us = 0

    def add(self, component: Component, steady_us: int) -> None:
        """Count one frame with this component, which arrived at ``steady_us`` on the steady clock."""
        self._first_us = self._first_us or steady_us
        self._last_us = steady_us
        self._num_frames += 1
        self._timestamps_us.append(component.timestamp_us)
        message_bytes = ITEMS_OFFSET + component.num_items * component.item_bytes
        self._largest_message_bytes = max(self._largest_message_bytes, message_bytes)
        if component.type not in COMPONENTS_WITH_VISIBILITY:
            return
        visible = is_visible(component.items())
        self._num_items += len(visible)
        self._num_visible_items += int(np.count_nonzero(visible))
        if len(visible) != len(self._was_visible):  # the layout has changed: start again
            self._was_visible = np.zeros(len(visible), np.bool_)
        self._was_visible |= visible

    @property
    def rate_hz(self) -> float:
        """Frames per second; 0 if fewer than two frames arrived.

        By the server's time stamps if they increase and agree with the arrival times, else by arrival times.
        Time stamps are better because delays of the network or of this program do not affect them. But some
        servers' time stamps are constant, jump, or are not in microseconds (field note 11).
        """
        intervals = self._num_frames - 1
        if intervals < 1:
            return 0.0
        watched_us, span_us = self._last_us - self._requested_us, self._last_us - self._first_us
        arrival_hz = intervals * 1e6 / span_us if span_us > 0 else 0.0
        if any(later_us <= us for us, later_us in pairwise(self._timestamps_us)):
            return arrival_hz
        timestamp_hz = intervals * 1e6 / (self._timestamps_us[-1] - self._timestamps_us[0])
        # Frames that were delayed together arrive faster than they were sent, so only the time since the
        # request says how slow they can be.
        is_plausible = span_us <= 0 or (
            timestamp_hz < 2 * arrival_hz and timestamp_hz * watched_us > 0.5e6 * intervals
        )
        return timestamp_hz if is_plausible else arrival_hz

    @property
    def message_load(self) -> MessageLoad:
        """The messages that the gateway would publish for this component."""
        return MessageLoad(self.rate_hz, self._largest_message_bytes)

    @property
    def visible_share(self) -> float | None:
        """The share of markers or tools in view, over all frames; None if there were no items."""
        return self._num_visible_items / self._num_items if self._num_items else None

    @property
    def never_visible_indices(self) -> list[int]:
        """The indices of markers or tools that were in view in no frame."""
        return [int(index) for index in np.flatnonzero(~self._was_visible)]


class ObservedStream:
    """One stream of a source, on its own connection. Create it in a running event loop.

    If it ``plans``, it requests what the gateway requests on the first connection of ``streams: auto``.
    """

    def __init__(self, source: SourceSettings, stream: StreamSettings, *, plans: bool = False) -> None:
        self.settings = stream
        self.requests_all = source.streams == "auto" or set(stream.components) == set(WIRE_ORDER)
        """Whether the components are the default, which is all, instead of chosen in the configuration."""
        self.component_keys = component_keys(stream.components)
        self.status = StreamStatus(self.component_keys, name=stream_name(source, stream.components))
        self.parsed: ParsedParameters | None = None
        self.observed: dict[ComponentType, ObservedComponent] = {}
        self.session = Session(source, stream, self.status, self._on_frames)
        self.control = StreamRequests(
            source, stream, self.status, self.session, self._read_parameters, self._planned_components
        )
        self._plans = plans
        self._requested_us = 0
        self.plan = StreamPlan()
        """What the server's rates need, with ``streams: auto``."""
        self.shares_connection = False
        """Whether components of several rates share this connection because the server serves one only."""

    @property
    def silence_s(self) -> float:
        """How long no frame has arrived, in s; 0 before the first frame."""
        last_frame_s = self.status.last_frame_s
        return 0.0 if last_frame_s is None else running_clock().time() - last_frame_s

    def _planned_components(self, parameters: Parameters | None) -> Sequence[ComponentType]:
        self._requested_us = now_steady_us()  # the request follows
        if self._plans:
            self.plan = plan_streams(parameters)
            self._set_components(self.plan.groups[0])
        return self.settings.components

    def _set_components(self, components: tuple[ComponentType, ...]) -> None:
        self.settings = self.settings.model_copy(update={"components": components})
        self.component_keys = component_keys(components)

    async def use_one_connection(self, reason: str) -> None:
        """Request all components on this connection, as the gateway does if a further one fails."""
        self.shares_connection = True
        plan = self.plan.on_one_connection(reason)
        self.status.add_limitation(plan.limitation)
        self._set_components(plan.groups[0])
        await self.control.request_components(plan.groups[0])

    async def _read_parameters(self, connection: Connection) -> ParsedParameters:
        packet = await connection.ask(SendParameters())
        self.parsed = await WorkerThread("xml").run(lambda: parse_parameters(packet.body))
        return self.parsed

    @property
    def load_bytes_per_s(self) -> float:
        """What the server sends on this connection, in bytes per second."""
        loads = [component.message_load for component in self.observed.values()]
        return sum(load.rate_hz * load.largest_bytes for load in loads)

    def _on_frames(self, frames: list[RawFrame], _utime: int, steady_us: int) -> None:
        self.status.frames_in += len(frames)
        for frame in frames:
            for component in frame.components:
                if component.type in self.settings.components:
                    if component.type not in self.observed:
                        self.observed[component.type] = ObservedComponent(self._requested_us)
                    self.observed[component.type].add(component, steady_us)
