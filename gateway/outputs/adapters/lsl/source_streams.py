"""The LSL streams of one source: which are open, and what is pushed to them.

Everything here is called in the thread that sends, except where it says otherwise.
"""

import functools
import itertools
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.messages.coordinate_frame import MAX_FLOAT, NO_ROTATION, CoordinateFrame, product
from gateway.messages.descriptions.labels import EVENT_VALUES, event_text, event_time_us, printable
from gateway.messages.descriptions.source_frame import unknown_unit_text
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.lsl.process import Kind, Message, opening_content, samples_content
from gateway.outputs.adapters.lsl.streams import (
    CHANNELS_PER_ITEM,
    MAX_CHANNELS,
    LslSource,
    LslStream,
    changed_labels,
    lsl_stream,
    num_labels,
)
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.losses import Losses

Numbers = npt.NDArray[np.float64]


def samples(
    component: ComponentType, items: npt.NDArray[Any], frame: CoordinateFrame, num_items: int
) -> npt.NDArray[np.float32]:
    """Return one sample per frame, shape (frames, channels), with ``num_items`` items each.

    ``items`` are the fields of the items of equal components, shape (frames, items, fields). Items that they
    lack are NaN, like those out of view. The unit of length must be known for markers and tools.
    """
    num_frames, present = items.shape[:2]
    with np.errstate(all="ignore"):  # a server may send any values
        values = items.astype(np.float64)
        if component is ComponentType.MARKERS:
            values[..., :3] = frame.points(values[..., :3].reshape(-1, 3)).reshape(*values.shape[:2], 3)
            values[~_is_in_range(values[..., :3])] = np.nan
        elif component is ComponentType.TOOLS:
            values = _tools(values, frame)
        elif component is ComponentType.FORCE:
            values = frame.vectors(values.reshape(-1, 3)).reshape(values.shape)
        result = np.full((num_frames, num_items, values.shape[2]), np.nan, np.float32)
        result[:, :present] = values
    return result.reshape(num_frames, -1)


def _tools(items: Numbers, frame: CoordinateFrame) -> Numbers:
    """Return x, y, z, the quaternion as x, y, z, w, and the error, as ``CoordinateFrame.poses`` does."""
    assert frame.metres_per_unit is not None  # noqa: S101 - the caller has checked it
    q0, qx, qy, qz = (items[..., index] for index in range(4))
    result = np.empty_like(items)
    result[..., :3] = frame.points(items[..., 4:7].reshape(-1, 3)).reshape(*items.shape[:2], 3)
    if frame.rotation_xyzw == NO_ROTATION:
        orientation: Any = (qx, qy, qz, q0)
    else:
        orientation = product(frame.rotation_xyzw, (qx, qy, qz, q0))  # type: ignore[arg-type]  # arrays do, too
    result[..., 3:7] = np.stack(orientation, axis=-1)
    result[..., 7] = items[..., 7] * frame.metres_per_unit
    is_rotation = (items[..., :4] != 0).any(axis=-1)
    result[~(is_rotation & _is_in_range(result))] = np.nan
    return result


def _is_in_range(values: Numbers) -> npt.NDArray[np.bool_]:
    """Return which items have only numbers that a 32-bit float can hold; comparisons with NaN are false."""
    return np.asarray((abs(values) <= MAX_FLOAT).all(axis=-1))


MIN_LIFE_S: Final = 1.0
"""Streams of one component open at least so far apart: to open and close one costs threads and sockets."""

MAX_BUFFER_BYTES: Final = 64 * 1024 * 1024
"""The most that liblsl keeps of one stream for slow receivers, which share the samples."""

_IRREGULAR_SAMPLES: Final = 100
"""For a stream without a rate, liblsl takes a second of buffer as so many samples."""

NOT_OPEN: Final = "the process for LSL has ended; it is started again"

_MAX_VALUES: Final = 1_000_000
"""How many values are pushed at once. A frame of a few items may belong to a stream of many channels."""

_MAX_APART_US: Final = 1_000_000
"""Components of one frame have time stamps as near as this, or these are not those of one clock."""

_ITEMS_OFFSET: Final = 16  # of the items in a component's content
_MAX_EVENT_TEXTS: Final = 100
"""How many texts are remembered: the same button is pressed again and again."""

_POSITIONS: Final = frozenset({ComponentType.MARKERS, ComponentType.TOOLS})

logger = logging.getLogger(__name__)


class CapturedFrame(NamedTuple):
    """A frame, which of its components to push, and when it was captured, on the steady clock in µs."""

    frame: RawFrame
    stamp: Stamp
    components: frozenset[ComponentType]
    captured_us: int


@dataclass
class _OpenStream:
    """An open stream: its number, and how many items its channels are for, by which parameters."""

    number: int
    stream: LslStream
    num_items: int
    version: int

    def opening(self, buffer_s: int) -> Message:
        """Return the message that opens it."""
        stream = self.stream
        bytes_per_s = 4 * len(stream.channels) * (stream.rate_hz or _IRREGULAR_SAMPLES)
        facts = {
            "name": stream.name,
            "type": stream.type,
            "rate_hz": stream.rate_hz,
            "is_text": stream.is_text,
            "source_id": stream.source_id,
            "num_channels": len(stream.channels),
            "buffer_s": max(1, min(buffer_s, int(MAX_BUFFER_BYTES / bytes_per_s))),
        }
        return Message(Kind.OPEN, self.number, opening_content(facts, stream.tree))


class SourceStreams:
    """Opens the streams of one source, and pushes the samples that somebody receives.

    A stream opens with the parameters that describe its component, or else with its first frame. It stays
    open while the channels are the same: items that a frame lacks are NaN. More items, or other labels, units
    or axes, need another stream, because the channels of a stream are fixed.
    """

    def __init__(
        self, name: str, computer: str, buffer_s: int, numbers: Iterator[int], send: Callable[[Message], bool]
    ) -> None:
        self.source = name
        self.numbers: Mapping[ComponentType, int] = {}
        """The numbers of the open streams. Any thread may read it."""
        self.names: Mapping[str, Mapping[str, str]] = {}
        """By component key, the names of items whose labels the streams cannot use as they are."""
        self.waiting: dict[ComponentType, int] = {}
        """The numbers of items of streams that could not open yet, because the last one was too young."""
        self.losses = Losses(logger, f"{name} to lsl")
        """What is lost in the thread that sends."""
        self._computer = computer
        self._buffer_s = buffer_s
        self._next_numbers = numbers
        self._send = send
        self._described = LslSource(name, computer, Parameters(), CoordinateFrame(name))
        self._event_text = functools.lru_cache(_MAX_EVENT_TEXTS)(self._find_event_text)
        self._version = 0  # counts the parameters
        self._streams: dict[ComponentType, _OpenStream] = {}
        self._opened_s: dict[ComponentType, float] = {}  # also of streams that are closed again

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Open the streams that the parameters describe; close those of components without a section."""
        parsed = parameters.parsed
        self._described = LslSource(self.source, self._computer, parsed, parameters.frame)
        self._event_text.cache_clear()
        self._version += 1
        for component in WIRE_ORDER:
            count = num_labels(component, parsed)
            if count or (count is not None and component is ComponentType.EVENT):
                self._stream(component, 0)
            elif parsed != Parameters():
                self._close(component)

    def open_for(self, num_items: Mapping[ComponentType, int]) -> None:
        """Open the streams for so many items of each component, even if the parameters have fewer."""
        for component, count in num_items.items():
            if self._stream(component, count) is None:
                self._count_refused(component, count, 1)

    def push(self, frames: Sequence[CapturedFrame], wanted: frozenset[int], suspended_us: int) -> None:
        """Push the components whose streams are ``wanted``, oldest frame first.

        ``suspended_us`` is what the steady clock is ahead of LSL's.
        """

        def alike(captured: CapturedFrame) -> tuple[int, frozenset[ComponentType]]:
            return id(captured.frame.layout), captured.components

        for (_, components), group in itertools.groupby(frames, alike):
            together = list(group)
            for index, component in enumerate(together[0].frame.layout.components):
                if component.type not in components:
                    continue
                stream = self._stream(component.type, component.num_items)
                if stream is None:
                    self._count_refused(component.type, component.num_items, len(together))
                elif stream.number in wanted:
                    push = self._push_events if stream.stream.is_text else self._push_values
                    push(stream, together, index, suspended_us)

    def count_not_open(self, num_frames: int) -> None:
        """Count frames that waited for a process that has ended."""
        if num_frames:
            self._count_loss("not open", NOT_OPEN, num_frames)

    def open_waiting(self) -> None:
        """Open the streams that had to wait. Called about once a second."""
        waiting, self.waiting = self.waiting, {}
        for component, num_items in waiting.items():
            self._stream(component, num_items)

    def reopen(self) -> None:
        """Open all streams again, because the process that had them has ended."""
        for stream in self._streams.values():
            self._send(stream.opening(self._buffer_s))

    def close(self) -> None:
        """Close all streams."""
        self.waiting = {}
        for component in list(self._streams):
            self._close(component)

    def _stream(self, component: ComponentType, num_items: int) -> _OpenStream | None:
        """Return the stream for a component with ``num_items`` items; None if it has none now."""
        is_event = component is ComponentType.EVENT
        num_items = 1 if is_event else num_items
        before = self._streams.get(component)
        if before is not None and before.version == self._version and num_items <= before.num_items:
            return before
        if not is_event:
            num_items = max(num_items, num_labels(component, self._described.parameters) or 0)
        if before is not None and before.version == self._version:
            num_items = max(num_items, before.num_items)
        if not num_items or self._is_refused(component, num_items):
            self._close(component)
            return None
        # While a stream waits, its channels, which can be thousands, are not described for every frame.
        if before is None and self._must_wait(component, num_items):
            return None
        stream = lsl_stream(self._described, component, num_items)
        if before is not None and before.stream == stream:
            before.version = self._version
            return before
        self._close(component)
        return None if self._must_wait(component, num_items) else self._open(component, stream, num_items)

    def _must_wait(self, component: ComponentType, num_items: int) -> bool:
        """Return whether the last stream of a component is too young for another one, which then waits."""
        if time.monotonic() - self._opened_s.get(component, float("-inf")) >= MIN_LIFE_S:
            return False
        self.waiting[component] = num_items
        return True

    def _open(self, component: ComponentType, stream: LslStream, num_items: int) -> _OpenStream:
        self.waiting.pop(component, None)
        self._opened_s[component] = time.monotonic()
        opened = _OpenStream(next(self._next_numbers), stream, num_items, self._version)
        self._streams[component] = opened
        self.numbers = {**self.numbers, component: opened.number}
        names = changed_labels(self._described, component, num_items)
        self.names = {**self.names, component.key: names}
        self._send(opened.opening(self._buffer_s))
        return opened

    def _close(self, component: ComponentType) -> None:
        self.waiting.pop(component, None)
        closed = self._streams.pop(component, None)
        if closed is not None:
            self.numbers = {each: stream.number for each, stream in self._streams.items()}
            self.names = {key: names for key, names in self.names.items() if key != component.key}
            self._send(Message(Kind.CLOSE, closed.number))

    def _is_refused(self, component: ComponentType, num_items: int) -> bool:
        is_too_large = num_items * CHANNELS_PER_ITEM[component] > MAX_CHANNELS
        return is_too_large or (component in _POSITIONS and self._described.frame.metres_per_unit is None)

    def _count_refused(self, component: ComponentType, num_items: int, num_frames: int) -> None:
        """Count frames whose component can have no stream."""
        num_channels = num_items * CHANNELS_PER_ITEM[component]
        if num_channels > MAX_CHANNELS:
            self._count_loss(
                "too many channels",
                f"a {component.key} component with {num_items} {component.item_noun} needs {num_channels} "
                f"channels, more than {MAX_CHANNELS}: it gets no LSL stream",
                num_frames,
            )
        elif num_items and self._is_refused(component, num_items):
            text = unknown_unit_text(self._described.parameters)
            self._count_loss("unknown unit", text, num_frames)

    def _push_values(
        self, stream: _OpenStream, frames: Sequence[CapturedFrame], index: int, suspended_us: int
    ) -> None:
        layout = frames[0].frame.layout
        component = layout.components[index]
        start, end = layout.content_spans[index]
        dtype = np.dtype("f4").newbyteorder(layout.byte_order)
        num_together = max(1, _MAX_VALUES // len(stream.stream.channels))
        for first in range(0, len(frames), num_together):
            together = frames[first : first + num_together]
            data = b"".join([captured.frame.body[start + _ITEMS_OFFSET : end] for captured in together])
            shape = (len(together), component.num_items, component.item_bytes // 4)
            items = np.frombuffer(data, dtype).reshape(shape)
            times_s = [time_us / 1e6 for time_us, _ in _times_us(together, index, suspended_us)]
            values = samples(component.type, items, self._described.frame, stream.num_items)
            message = Message(Kind.SAMPLES, stream.number, samples_content(times_s, values))
            if not self._send(message):
                self._count_loss("not open", NOT_OPEN, len(together))

    def _push_events(
        self, stream: _OpenStream, frames: Sequence[CapturedFrame], index: int, suspended_us: int
    ) -> None:
        layout = frames[0].frame.layout
        start, end = layout.content_spans[index]
        dtype = frames[0].frame.component(index).items().dtype
        data = b"".join([captured.frame.body[start + _ITEMS_OFFSET : end] for captured in frames])
        items = np.frombuffer(data, dtype)
        own_us = items["timestamp"].tolist() if "timestamp" in (dtype.names or ()) else [None] * len(items)
        times_us = _times_us(frames, index, suspended_us)
        of_items = (time for time in times_us for _ in range(layout.components[index].num_items))
        times_s = []
        for (component_us, timestamp_us), event_us in zip(of_items, own_us, strict=True):
            event_us = timestamp_us if event_us is None else event_us  # noqa: PLW2901 - as the frame says
            times_s.append(event_time_us(component_us, timestamp_us, event_us) / 1e6)
        texts = [self._event_text(*values) for values in items[[*EVENT_VALUES]].tolist()]
        message = Message(Kind.TEXTS, stream.number, json.dumps((times_s, texts)).encode())
        if texts and not self._send(message):
            self._count_loss("not open", NOT_OPEN, len(frames))

    def _find_event_text(self, *values: int) -> str:
        text = event_text(self._described.parameters, dict(zip(EVENT_VALUES, values, strict=True)))
        return printable(f"{text.label}: {text.description}" if text.values else text.label)

    def _count_loss(self, cause: str, text: str, num_frames: int) -> None:
        self.losses.lost(cause, text, messages=num_frames, frames=num_frames)


def _times_us(frames: Sequence[CapturedFrame], index: int, suspended_us: int) -> list[tuple[int, int]]:
    """Return when a component of each frame was captured, on the monotonic clock, and its time stamp.

    All frames have one layout.
    """
    layout = frames[0].frame.layout
    unpack = layout.unpack_number_and_timestamp
    first, start = layout.content_spans[0][0], layout.content_spans[index][0]
    found = []
    for captured in frames:
        body = captured.frame.body
        _, first_us = unpack(body, first)
        _, timestamp_us = unpack(body, start)
        apart_us = timestamp_us - first_us
        captured_us = captured.captured_us - suspended_us
        found.append((captured_us + (apart_us if abs(apart_us) <= _MAX_APART_US else 0), timestamp_us))
    return found
