"""The frames of a measurement: its clock, the bytes of its packets, and what all clients share."""

import asyncio
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from typing import Final

import numpy as np

from gateway.rtc3d.components import (
    SHORT_EVENT,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    Items,
    encode_component,
)
from gateway.rtc3d.frames import encode_frame
from gateway.rtc3d.packets import PacketType, encode_packet
from gateway.rtc3d.parameters import General, Parameters, only_sections
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.session.server.scene import NO_EVENTS, DataPacket, FrameSource, SampleNumbers, Scene

_BLOCK_FRAMES: Final = 64
"""The scene computes this many frames in one call, because a call of numpy costs much more than a value."""

_CACHED_PACKETS: Final = 64  # clients with equal streams share them
_SECOND_US: Final = 1_000_000
_FRAME_NUMBERS: Final = 2**31  # the field is a signed 32-bit integer

MAX_LATE_US: Final = 1_000_000
"""Frames that are later than this are dropped; less late ones are still sent."""


def exact_rate(rate_hz: float) -> Fraction:
    """Return the exact value of a rounded rate, such as 60000/1001 for 59.94006."""
    return Fraction(rate_hz).limit_denominator(1001)


class FrameBuilder:
    """Builds the frames that have certain components of a scene (see FrameSource).

    There is one frame for each tick of ``rate``, the rate of the slowest measured component in them
    (§5.3.5); ticks are counted from 0 at the start of the measurement. A frame has the newest sample
    of each component at its tick, and all components have the tick's time stamp. A FrameNumber is
    the number of the component's own sample, from 1.

    ``requested`` are the components of a command; an empty sequence means all. Components that the
    scene lacks are left out. ``event_bytes`` is the size of an event: 24 as NDI's code writes events, or 16
    as in §7.7 (field note 6).
    """

    def __init__(
        self, scene: "ComputedScene", requested: Sequence[ComponentType], event_bytes: int = 24
    ) -> None:
        chosen = [component for component in WIRE_ORDER if not requested or component in requested]
        rates = {c: exact_rate(scene.rates_hz[c]) for c in chosen if c in scene.rates_hz}
        measurement_rate = exact_rate(scene.measurement_rate_hz)
        events = scene.parameters.events
        self._scene = scene
        self._event_bytes = event_bytes
        self.measured = tuple(rates)
        """The components of each frame except events, in wire order."""
        self.has_events = ComponentType.EVENT in chosen and events is not None and bool(events.events)
        self.rate = min(rates.values(), default=measurement_rate)
        """Ticks per second."""
        self._samples_per_tick = [rates[component] / self.rate for component in self.measured]
        self._events_per_tick = measurement_rate / self.rate
        self._packet = lru_cache(_CACHED_PACKETS)(self._build_packet)
        self._block = lru_cache(4)(self._build_block)

    def time_us(self, tick: int) -> int:
        """Return the tick's time in µs since the start of the measurement."""
        return time_us(tick, self.rate)

    def tick_after(self, elapsed_us: int) -> int:
        """Return the first tick whose time is later than ``elapsed_us``."""
        return -(-(elapsed_us + 1) * self.rate.numerator // (_SECOND_US * self.rate.denominator))

    def oldest_us(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return elapsed_us - MAX_LATE_US

    def packet(self, byte_order: ByteOrder, tick: int, events_from_us: int | None = None) -> DataPacket:
        """See FrameSource. The frame has an event component if there are events."""
        if events_from_us is not None and self.has_events:
            events = self._scene.events(events_from_us, self.time_us(tick) + 1)
            if len(events):
                return self._build_packet(byte_order, tick, events)
        return self._packet(byte_order, tick)

    def _build_packet(self, byte_order: ByteOrder, tick: int, events: Items = NO_EVENTS) -> DataPacket:
        timestamp_us = self.time_us(tick)
        block = self._block(byte_order, tick // _BLOCK_FRAMES)
        row = tick % _BLOCK_FRAMES
        components = self.measured
        parts = [
            encode_component(component, _frame_number(tick, per_tick), timestamp_us, items[row], byte_order)
            for component, per_tick, items in zip(components, self._samples_per_tick, block, strict=True)
        ]
        if len(events):
            components = (*components, ComponentType.EVENT)
            number = _frame_number(tick, self._events_per_tick)
            if self._event_bytes == SHORT_EVENT.itemsize:
                events = events[["id", "param1", "param2", "param3"]].astype(SHORT_EVENT)
            parts.append(encode_component(ComponentType.EVENT, number, timestamp_us, events, byte_order))
        packet = encode_packet(PacketType.DATA, encode_frame(parts, byte_order))
        return DataPacket(packet, components)

    def _build_block(self, byte_order: ByteOrder, number: int) -> list[Items]:
        """Return each measured component's items for a block of ticks, shape (_BLOCK_FRAMES, items)."""
        ticks = np.arange(number * _BLOCK_FRAMES, (number + 1) * _BLOCK_FRAMES, dtype=np.int64)
        block = []
        for component, per_tick in zip(self.measured, self._samples_per_tick, strict=True):
            items = self._scene.items(component, ticks * per_tick.numerator // per_tick.denominator)
            block.append(items.astype(items.dtype.newbyteorder(byte_order), copy=False))
        return block


def time_us(tick: int, rate: Fraction) -> int:
    """Return the time of a tick of ``rate`` in µs since the start of the measurement."""
    return tick * _SECOND_US * rate.denominator // rate.numerator


def _frame_number(tick: int, per_tick: Fraction) -> int:
    return (tick * per_tick.numerator // per_tick.denominator + 1) % _FRAME_NUMBERS


class ComputedScene(ABC):
    """A Scene that is a function of time alone: subclasses define the attributes, ``items`` and ``events``.

    These never block, and always return the same values for the same arguments, so that all clients see the
    same scene even if their streams differ.
    """

    parameters: Parameters
    """All sections of §6 except General."""

    rates_hz: Mapping[ComponentType, float]
    """The rate in Hz of each measured component of the scene; components without items are missing."""

    measurement_rate_hz: float
    """The rate of frames in a measurement, and of streams that have only events."""

    num_frames: int | None = None
    """The number of frames in one pass, at ``measurement_rate_hz``; None if the scene has no end."""

    @abstractmethod
    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """Return a measured component's items, shape (len(samples), number of items).

        The dtype is that of ITEM_DTYPES. The first sample of a pass follows the last one.
        """

    @abstractmethod
    def events(self, start_us: int, stop_us: int) -> Items:
        """Return the events (LONG_EVENT) with time stamps in [start_us, stop_us), in order."""

    @property
    def length_us(self) -> int | None:
        """See Scene."""
        if self.num_frames is None:
            return None
        return time_us(self.num_frames, exact_rate(self.measurement_rate_hz))

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """See Scene."""
        return encode_parameters(only_sections(replace(self.parameters, general=general), sections))

    def start(self) -> None:  # noqa: B027 - there is nothing to prepare
        """See Scene."""

    def advance(self, elapsed_us: int) -> int | None:  # noqa: ARG002 - there is nothing to prepare
        """See Scene. There is nothing to prepare."""
        return None

    def stop(self) -> None:  # noqa: B027 - there is nothing to release
        """See Scene."""

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> FrameBuilder:
        """See Scene."""
        return FrameBuilder(self, components, event_bytes)


LEAD_US: Final = 1_000_000
"""With ``once``, a measurement begins this long after a request for frames. So a client with several
connections, such as a gateway, gets the first frames on all of them."""

MAX_LEAD_US: Final = 2_000_000
"""Further requests postpone the beginning, but not for longer than this after the first one."""


class Measurement:
    """The clock of a measurement of a scene, which can be started and stopped repeatedly.

    ``event_bytes`` is 24 or 16, as in Scene. With ``once``, time stops after one pass of a scene
    that has an end; otherwise it runs until ``stop``.
    """

    def __init__(self, scene: Scene, *, event_bytes: int, once: bool) -> None:
        self.scene = scene
        """The scene that clients see."""
        self.advance_us: int | None = None
        """When ``advance`` is to be called again; None for never."""
        self._event_bytes = event_bytes
        self._once = once
        self._frames: dict[frozenset[ComponentType], FrameSource] = {}
        self._played = scene  # the scene at the start, which goes on while faults show another one
        self._started_us: int | None = None  # on the monotonic clock; None while no measurement is running
        self._latest_start_us = 0

    @property
    def is_running(self) -> bool:
        """Whether a measurement is running."""
        return self._started_us is not None

    @property
    def last_us(self) -> int | None:
        """The time of the last µs of the only pass; None if the measurement has no end that is known yet."""
        length_us = self._played.length_us if self._once else None
        # minus 1, because exactly at the end the first frame of the next pass would be due
        return None if length_us is None else length_us - 1

    def start(self) -> None:
        """Start at time 0; with ``once``, at -LEAD_US."""
        now_us = _now_us()
        self._started_us = now_us + LEAD_US if self._once else now_us
        self._latest_start_us = now_us + MAX_LEAD_US
        self._frames.clear()
        self._played = self.scene
        self._played.start()
        self.advance()

    def postpone(self) -> None:
        """Begin LEAD_US from now, if the measurement has not begun yet."""
        now_us = _now_us()
        if self._started_us is not None and now_us < self._started_us:
            self._started_us = min(now_us + LEAD_US, self._latest_start_us)

    def stop(self) -> None:
        """Stop, if it is running."""
        if self._started_us is not None:
            self._started_us = None
            self._played.stop()

    def elapsed_us(self) -> int | None:
        """Return the time since the start in µs, at most ``last_us``; None while none is running."""
        if self._started_us is None:
            return None
        elapsed_us = _now_us() - self._started_us
        last_us = self.last_us
        return elapsed_us if last_us is None else min(elapsed_us, last_us)

    def advance(self) -> None:
        """Prepare the next frames; call it at ``advance_us`` or sooner."""
        elapsed_us = self.elapsed_us()
        self.advance_us = None if elapsed_us is None else self._played.advance(elapsed_us)

    def change_scene(self, scene: Scene) -> None:
        """Show another scene from now on; the time continues."""
        self.scene = scene
        self._frames.clear()

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Return the frames with these components; an empty sequence means all.

        Clients with the same components share them.
        """
        choice = frozenset(components)
        if choice not in self._frames:
            self._frames[choice] = self.scene.frames(components, self._event_bytes)
        return self._frames[choice]


def _now_us() -> int:
    return time.monotonic_ns() // 1000


def call_after_us(delay_us: float, callback: Callable[[], object]) -> asyncio.TimerHandle:
    """Call ``callback`` after ``delay_us``, rounded up to whole milliseconds; at once if not positive.

    uvloop's timers count whole milliseconds. Without rounding up, a timer could fire just before its
    time, find nothing due and be set again, many times over.
    """
    delay_ms = max(0, math.ceil(delay_us / 1000))
    return asyncio.get_running_loop().call_later(delay_ms / 1000, callback)
