"""The moments of a take: which recorded components belong to the same frame, and when it is due."""

import struct
from bisect import bisect_right, insort
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from typing import Final

import numpy as np

from gateway.errors import ParametersError
from gateway.rtc3d.components import (
    FRAME_NUMBER_AND_TIMESTAMP,
    ITEM_DTYPES,
    SHORT_EVENT,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    Items,
    described_rate_hz,
    encode_component,
    num_described_items,
)
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)
from gateway.rtc3d.parameters_xml import encode_parameters, parse_parameters

_HEAD: Final = struct.Struct(">iqi")
"""The fields of a content before its items: frame number, time stamp in µs, number of items."""

_SIZE_AND_TYPE: Final = struct.Struct(">II")
_SIZE_AND_TYPE_BYTES: Final = 8


def is_whole(component: ComponentType, content: bytes) -> bool:
    """Return whether a recorded content has as many items as it says."""
    if len(content) < _HEAD.size:
        return False
    return len(content) == _HEAD.size + num_items(content) * ITEM_DTYPES[component].itemsize


def num_items(content: bytes) -> int:
    """Return the number of items in a content."""
    count: int = _HEAD.unpack_from(content)[2]
    return count


def items(component: ComponentType, content: bytes) -> Items:
    """Return the items of a content, shape (items,), as in ITEM_DTYPES."""
    return np.frombuffer(content, ITEM_DTYPES[component], offset=_HEAD.size)


def component_bytes(
    component: ComponentType, contents: Sequence[bytes], byte_order: ByteOrder, event_bytes: int
) -> bytes:
    """Return the bytes of a component (§7.1) from its recorded content.

    Several contents, which only events have, become one component with all their items, and with the frame
    number and time stamp of the last one. ``event_bytes`` is 24 or 16.
    """
    is_short = component is ComponentType.EVENT and event_bytes == SHORT_EVENT.itemsize
    content = contents[-1]
    if byte_order == "big" and len(contents) == 1 and not is_short:
        return _SIZE_AND_TYPE.pack(_SIZE_AND_TYPE_BYTES + len(content), component) + content
    values = np.concatenate([items(component, each) for each in contents])
    if is_short:
        values = values[list(SHORT_EVENT.names or ())].astype(SHORT_EVENT)
    frame_number, timestamp_us, _ = _HEAD.unpack_from(content)
    return encode_component(component, frame_number, timestamp_us, values, byte_order)


_TOLERANCE_US: Final = 250_000
"""Time stamps that differ by more than this from the time of capture are not followed any more."""

_MAX_STEP_US: Final = 1_000_000
"""If the clock of the recording computer was set, time stamps still advance by at most this much."""

_PROOF_US: Final = 1_000_000
"""After time stamps were not plausible, they must advance like the time of capture for this long."""

_MAX_PAUSE_US: Final = 86_400_000_000
"""A longer pause is no real one: the computer's clock was set, or a time is damaged."""

_DRIFT: Final = 1e-3
"""Two clocks may differ by this much of the elapsed time; a crystal is off by 1e-4 at most."""


class TakeTimeline:
    """Places the messages of one source on the time of its take, in µs from the first one.

    A server has one clock, which all its components share. Its time stamps are followed while they advance
    as the time of capture does. They do not if the server restarts, if they wrap around, or if they are no
    times at all. Then the time of capture counts until they have proved themselves for a second. If it is
    the time of capture that jumps, because somebody has set the recording computer's clock, the time stamps
    still count.
    """

    def __init__(self) -> None:
        self._server_offset_us: int | None = None  # the time in the take minus the time stamp
        self._capture_offset_us = 0  # the time in the take minus the time of capture
        self._capture_utime = 0  # of the newest message
        self._newest_us = 0
        self._trusted_from_utime: int | None = None  # when time stamps can be trusted again; None for now
        self._last: dict[ComponentType, tuple[int, int, int]] = {}

    def time_us(self, component: ComponentType, session: int, timestamp_us: int, capture_utime: int) -> int:
        """Return when a message is due. ``session`` is the number of its connection to the server."""
        if self._server_offset_us is None:
            self._server_offset_us = -timestamp_us
            self._capture_offset_us = -capture_utime
            self._capture_utime = capture_utime
        last = self._last.get(component)
        self._last[component] = (session, timestamp_us, capture_utime)
        server_us = timestamp_us + self._server_offset_us
        captured_us = capture_utime + self._capture_offset_us
        is_repeated = last is not None and last[0] == session and timestamp_us <= last[1]
        if not is_repeated and abs(server_us - captured_us) <= _TOLERANCE_US:
            if self._trusted_from_utime is not None and capture_utime >= self._trusted_from_utime:
                self._trusted_from_utime = None
            time_us = captured_us
            if self._trusted_from_utime is None:
                time_us = server_us
                limit_us = int(_DRIFT * max(0, capture_utime - self._capture_utime))
                if limit_us:  # otherwise too little time has passed
                    self._capture_offset_us += max(-limit_us, min(server_us - captured_us, limit_us))
                    self._capture_utime = capture_utime
        elif self._trusted_from_utime is None and _has_clock_step(last, session, timestamp_us, capture_utime):
            self._capture_offset_us += server_us - captured_us
            self._capture_utime = capture_utime
            time_us = server_us
        else:
            time_us = captured_us
            if not -_TOLERANCE_US <= captured_us - self._newest_us <= _MAX_PAUSE_US:
                self._capture_offset_us += self._newest_us - captured_us
                time_us = self._newest_us
            self._server_offset_us = time_us - timestamp_us
            self._trusted_from_utime = capture_utime + _PROOF_US
            self._capture_utime = capture_utime
        self._newest_us = max(self._newest_us, time_us)
        return time_us


def _has_clock_step(
    last: tuple[int, int, int] | None, session: int, timestamp_us: int, capture_utime: int
) -> bool:
    """Return whether time stamps continue, while the time of capture jumps."""
    if last is None or last[0] != session:
        return False
    step_us = timestamp_us - last[1]
    return 0 < step_us <= _MAX_STEP_US and abs(capture_utime - last[2] - step_us) > _TOLERANCE_US


class RecordedParameters:
    """The parameters of a server while they do not change. ``xml`` is its own text."""

    def __init__(self, xml: bytes) -> None:
        self.xml = xml

    @cached_property
    def parsed(self) -> Parameters:
        """The content of the XML; empty if it cannot be read."""
        try:
            return parse_parameters(self.xml).parameters
        except ParametersError:
            return Parameters()

    @cached_property
    def rates_hz(self) -> Mapping[ComponentType, float]:
        """The rates that the server announces for the components that it has items of."""
        return {
            component: rate_hz
            for component in WIRE_ORDER
            if num_described_items(self.parsed, component)
            and (rate_hz := described_rate_hz(self.parsed, component)) is not None
        }


_REORDER_US: Final = 500_000
"""Components of one frame that were recorded on two connections are at most this far apart in a take."""

_RELEASE_US: Final = 50_000
"""Moments are released together, because each release costs more than a moment."""

_MAX_WAITING: Final = 20_000
"""How many moments wait for further components at most."""

_DUE_US: Final = attrgetter("due_us")
_UNPACK: Final = FRAME_NUMBER_AND_TIMESTAMP["big"].unpack_from


@dataclass(slots=True)
class Moment:
    """The components that a server measured at one time, from one connection or several.

    ``due_us`` is the time in the take. ``contents`` are frame number, time stamp, count and items of each
    component, big-endian, as recorded. ``parameters`` are those that were valid.
    """

    due_us: int
    timestamp_us: int
    parameters: RecordedParameters
    contents: dict[ComponentType, bytes] = field(default_factory=dict)
    is_complete: bool = False
    """Whether no further component can be added."""

    @property
    def num_bytes(self) -> int:
        """The size of the contents."""
        return sum(map(len, self.contents.values()))


_MAX_EVENT_KINDS: Final = 1000


def derived_parameters(
    moments: Iterable[Moment], rates_hz: Mapping[ComponentType, float]
) -> RecordedParameters:
    """Return minimal parameters for these moments: numbered items, and rates rounded to 0.01 Hz."""
    counts: dict[ComponentType, int] = {}
    event_ids: set[int] = set()
    for moment in moments:
        for component, content in moment.contents.items():
            counts[component] = max(counts.get(component, 0), num_items(content))
            if component is ComponentType.EVENT:
                event_ids.update(items(component, content)["id"].tolist())

    def numbered(component: ComponentType, noun: str) -> Iterator[tuple[str, str]]:
        """Yield the id and the label of each item."""
        return ((str(number), f"{noun} {number}") for number in range(1, counts.get(component, 0) + 1))

    rate_hz = {component: round(rate, 2) for component, rate in rates_hz.items()}.get
    analog_hz, force_hz = rate_hz(ComponentType.ANALOG), rate_hz(ComponentType.FORCE)
    markers = (Marker(*each) for each in numbered(ComponentType.MARKERS, "Marker"))
    tools = (Tool(*each) for each in numbered(ComponentType.TOOLS, "Tool"))
    channels = (
        AnalogChannel(*each, frequency_hz=analog_hz) for each in numbered(ComponentType.ANALOG, "Analog")
    )
    plates = (Plate(*each, frequency_hz=force_hz) for each in numbered(ComponentType.FORCE, "Force plate"))
    kinds = sorted(event_ids)[:_MAX_EVENT_KINDS]
    events = (EventDefinition(str(event_id), f"Event {event_id}") for event_id in kinds)
    return RecordedParameters(
        encode_parameters(
            Parameters(
                markers=Parameters3D(rate_hz(ComponentType.MARKERS), markers=tuple(markers)),
                tools=Parameters6D(rate_hz(ComponentType.TOOLS), tuple(tools)),
                analog=ParametersAnalog(tuple(channels)),
                force=ParametersForce(tuple(plates)),
                events=ParametersEvents(tuple(events)),
            )
        )
    )


class MomentBuilder:
    """Puts recorded components together into moments, in the order of their times.

    Components with the same time stamp, or the same stamp, are one moment. The messages of one component
    keep their order, and no two moments have the same time.
    """

    def __init__(self) -> None:
        self._timeline = TakeTimeline()
        self._waiting: list[Moment] = []  # in the order of their times
        self._by_timestamp: dict[int, Moment] = {}  # the newest ones of those that wait
        self._newest: Moment | None = None
        self._newest_stamp = b""
        self._newest_us = 0
        self._last_us: dict[ComponentType, int] = {}  # the newest moment of each component
        self._released_us = -1

    def add(
        self,
        component: ComponentType,
        capture_utime: int,
        session: int,
        stamp: bytes,
        content: bytes,
        parameters: RecordedParameters,
    ) -> list[Moment]:
        """Add a recorded component; return the moments that are complete now.

        ``stamp`` is equal for all components of one frame of one connection.
        """
        _, timestamp_us = _UNPACK(content)
        due_us = self._timeline.time_us(component, session, timestamp_us, capture_utime)
        earliest_us = self._last_us.get(component, -1) + 1
        due_us = max(due_us, earliest_us)
        moment = self._by_timestamp.get(timestamp_us)
        if moment is None and stamp == self._newest_stamp:
            moment = self._newest
        if (
            moment is None
            or component in moment.contents
            or moment.due_us < earliest_us
            or moment.is_complete
            or abs(moment.due_us - due_us) > _REORDER_US
        ):
            moment = Moment(due_us, timestamp_us, parameters)
            if not self._waiting or self._waiting[-1].due_us <= due_us:
                self._waiting.append(moment)
            else:
                insort(self._waiting, moment, key=_DUE_US)
            self._newest, self._newest_stamp = moment, stamp
            self._newest_us = max(self._newest_us, due_us)
        self._by_timestamp[timestamp_us] = moment
        moment.contents[component] = content
        self._last_us[component] = moment.due_us
        until_us = self._newest_us - _REORDER_US
        if len(self._waiting) > _MAX_WAITING:
            until_us = self._waiting[_MAX_WAITING // 2].due_us
        elif self._waiting[0].due_us > until_us - _RELEASE_US:
            return []
        return self._release(until_us)

    def finish(self) -> list[Moment]:
        """Return the moments that are left."""
        return self._release(self._newest_us)

    def _release(self, until_us: int) -> list[Moment]:
        count = bisect_right(self._waiting, until_us, key=_DUE_US)
        if not count:
            return []
        released, self._waiting = self._waiting[:count], self._waiting[count:]
        for moment in released:
            self._released_us = moment.due_us = max(moment.due_us, self._released_us + 1)
            moment.is_complete = True
        if not self._waiting or len(self._by_timestamp) > 2 * len(self._waiting) + 1000:
            self._by_timestamp = {each.timestamp_us: each for each in self._waiting}
        return released
