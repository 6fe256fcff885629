"""What is seen of one stream while the doctor watches it: rates, sizes, markers in view."""

import numpy as np
import numpy.typing as npt

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.splice import ITEMS_OFFSET
from gateway.rtc3d.components import Component, ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.session import Handlers, Session
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl


class ComponentSeen:
    """One component's frames: how many, when, how large, and which of their items are in view."""

    def __init__(self) -> None:
        self.frames = 0
        self.message_bytes = 0
        """The largest message that this component makes on Zenoh and LCM."""
        self._items = 0
        self._visible_items = 0
        self._visible: npt.NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._timestamps_us: list[int] = []
        self._first_utime = self._last_utime = 0

    def add(self, component: Component, utime: int) -> None:
        """Count one frame of this component, which came at ``utime``."""
        self._first_utime = self._first_utime or utime
        self._last_utime = utime
        self.frames += 1
        self._timestamps_us.append(component.timestamp_us)
        size = ITEMS_OFFSET + component.num_items * component.item_bytes
        self.message_bytes = max(self.message_bytes, size)
        if component.type in {ComponentType.MARKERS, ComponentType.TOOLS}:
            self._look(component)

    def _look(self, component: Component) -> None:
        items = component.items()
        missing = np.isnan(items["x"]) | np.isnan(items["y"]) | np.isnan(items["z"])  # any (field note 7)
        visible = ~missing
        self._items += len(visible)
        self._visible_items += int(np.count_nonzero(visible))
        if len(visible) != len(self._visible):
            self._visible = np.zeros(len(visible), np.bool_)  # another layout: seen anew
        self._visible |= visible

    @property
    def rate_hz(self) -> float:
        """Frames per second, by the server's time stamps if they can be believed, else as they came.

        Time stamps do not see the network, nor a pause of this program; but some servers' stand still,
        jump, or are no microseconds (field note 11). 0 with fewer than two frames.
        """
        gaps = self.frames - 1
        span_s = (self._last_utime - self._first_utime) / 1e6
        came_hz = gaps / span_s if gaps > 0 and span_s > 0 else 0.0
        steps_us = np.diff(np.array(self._timestamps_us, np.int64))
        if gaps < 1 or bool(np.any(steps_us <= 0)):
            return came_hz
        stamped_hz = gaps * 1e6 / float(steps_us.sum())
        return stamped_hz if not came_hz or 0.5 < stamped_hz / came_hz < 2 else came_hz

    @property
    def visible_share(self) -> float | None:
        """The share of markers or tools in view, over all frames; None without any."""
        return self._visible_items / self._items if self._items else None

    @property
    def never_visible(self) -> list[int]:
        """The indices of those that were in view in no frame."""
        return [int(index) for index in np.flatnonzero(~self._visible)]


class StreamWatch:
    """One stream of a source, in a connection of its own; make it in a running event loop."""

    def __init__(self, source: SourceSettings, stream: StreamSettings) -> None:
        self.stream = stream
        self.components = " ".join(component.key for component in stream.components)
        self.status = StreamStatus(self.components, name=f"{source.name} ({self.components})")
        self.parsed: ParsedParameters | None = None
        self.seen: dict[ComponentType, ComponentSeen] = {}
        handlers = Handlers(self._take, self._learn, lambda _content: None)
        self.session = Session(source, stream, self.status, handlers)
        self.negotiation = StreamControl(source, stream, self.status, self.session)

    def _learn(self, _xml: bytes, parsed: ParsedParameters) -> None:
        self.parsed = parsed

    def _take(self, frames: list[Frame], utime: int, _now_s: float) -> None:
        self.status.frames_in += len(frames)
        for frame in frames:
            for component in frame.components:
                if component.type in self.stream.components:
                    self.seen.setdefault(component.type, ComponentSeen()).add(component, utime)
