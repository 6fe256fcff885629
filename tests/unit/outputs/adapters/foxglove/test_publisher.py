"""The queue of frames and calls of one source, which viewers get in their order."""

import asyncio
import re
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.foxglove import output
from gateway.outputs.adapters.foxglove.output import FoxglovePublisher
from gateway.outputs.adapters.foxglove.server import FoxgloveServer
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.workers import MAX_CALLS
from tests.unit.outputs.adapters.foxglove.live import ANALOG, ITEMS, MARKERS, frame_of

LAYOUTS = (frame_of({MARKERS: ITEMS[MARKERS]}), frame_of({ANALOG: ITEMS[ANALOG], MARKERS: ITEMS[MARKERS]}))
WANTED: frozenset[ComponentType] = frozenset({MARKERS, ANALOG})


class Viewer:
    """Takes clouds, which name the coordinate frame of the parameters that they were made with."""

    def __init__(self) -> None:
        self.subscriptions: dict[int, int] = {}
        self.received: list[tuple[int, int]] = []

    def send_message(self, _number: int, utime: int, data: bytes) -> bool:
        found = re.search(rb"frame(\d+)", data)
        assert found is not None
        self.received.append((utime, int(found[1])))
        return True


class Lab:
    """A publisher whose thread the test stands for, and a viewer of the markers."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []
        self.viewer = Viewer()
        server = FoxgloveServer("127.0.0.1", 0, "1")
        self.publisher = FoxglovePublisher("lab", server, self.calls.append)
        self.publisher.wanted = WANTED
        self.publisher.open()
        self.use_parameters(0)
        self.calls.clear()
        self.publisher._send_waiting()
        [markers] = [each for each in server._channels.values() if each.topic.name == "/lab/markers"]
        subscriber: Any = self.viewer
        server._subscribe(subscriber, 1, markers.number)

    def use_parameters(self, version: int) -> None:
        frame = CoordinateFrame(f"frame{version}")
        self.publisher.set_parameters(ServerParameters(b"", 1, version, parsed=Parameters(), frame=frame))

    def publish(self, utime: int, step: str = "first") -> None:
        components = frozenset({MARKERS}) if step == "fewer" else WANTED
        self.publisher.publish(LAYOUTS[step != "first"], Stamp(utime, utime, 1, 1), components)

    def send_all(self) -> None:
        """Send what waits, without a pause, in as many turns of the loop as that takes."""

        async def turns() -> None:
            self.publisher._send_waiting()
            while self.publisher._waiting:  # noqa: ASYNC110 - nothing signals it
                await asyncio.sleep(0)

        self.calls.clear()
        asyncio.run(turns())


@given(
    st.lists(st.sampled_from(("first", "second", "fewer", "parameters", "send"))),
    st.sampled_from((1, 500, 10**6)),
)
def test_frames_are_sent_in_order_with_the_parameters_that_were_valid_when_they_came(
    schedule: list[str], together_bytes: int
) -> None:
    """However many are handed over or sent together; the thread is woken once for all of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, "_MAX_TOGETHER_BYTES", together_bytes)
        follow(schedule)


def follow(schedule: list[str]) -> None:
    lab = Lab()
    expected: list[tuple[int, int]] = []
    num_waiting = version = 0
    for utime, step in enumerate([*schedule, "send"]):
        if step == "send":
            assert len(lab.calls) == min(num_waiting, 1)
            lab.send_all()
            num_waiting = 0
            assert lab.viewer.received == expected
            continue
        num_waiting += 1
        if step == "parameters":
            version += 1
            lab.use_parameters(version)
        else:
            lab.publish(utime, step)
            expected.append((utime, version))


async def test_frames_wait_for_the_end_of_the_pause_but_not_the_first_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At a low rate, no frame is late; at a high one, a viewer costs little."""
    lab = Lab()
    for pause_s, num_sent in ((3600.0, 1), (3600.0, 1), (0.0, 3)):
        monkeypatch.setattr(output, "MIN_PAUSE_S", pause_s)
        lab.publish(1)
        if lab.calls:
            lab.calls.pop()()
        if not pause_s:  # the timer's call
            lab.publisher._send_soon()
        assert len(lab.viewer.received) == num_sent


def test_frames_that_find_no_place_are_refused_until_those_before_are_sent() -> None:
    """The memory is bounded if the thread does not come round to it."""
    lab = Lab()
    for _ in range(2):
        for utime in range(MAX_CALLS):
            lab.publish(utime)
        with pytest.raises(OutputError) as refused:
            lab.publish(MAX_CALLS)
        assert refused.value.cause == "queue full"
        lab.send_all()
    assert len(lab.viewer.received) == 2 * MAX_CALLS


async def test_connections_get_a_turn_before_all_of_large_frames_are_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise, a viewer that reads in time would lose what a busy computer has delayed."""
    lab = Lab()
    monkeypatch.setattr(output, "_MAX_TOGETHER_BYTES", 2 * len(LAYOUTS[0].body))
    for utime in range(5):
        lab.publish(utime)
    lab.calls.pop()()
    for num_sent in (2, 4, 5):
        assert len(lab.viewer.received) == num_sent
        await asyncio.sleep(0)
