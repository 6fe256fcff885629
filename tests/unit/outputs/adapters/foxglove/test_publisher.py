"""The queue of frames and calls of one source, which viewers get in their order."""

import re
from collections.abc import Callable
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.foxglove.output import FoxglovePublisher
from gateway.outputs.adapters.foxglove.server import FoxgloveServer
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
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


@given(st.lists(st.sampled_from(("first", "second", "fewer", "parameters", "turn"))))
def test_frames_are_sent_in_order_with_the_parameters_that_were_valid_when_they_came(
    schedule: list[str],
) -> None:
    """However many are handed over together; the thread is woken once for all of them."""
    calls: list[Callable[[], None]] = []
    server, viewer = FoxgloveServer("127.0.0.1", 0, "1"), Viewer()
    publisher = FoxglovePublisher("lab", server, calls.append)
    publisher.wanted = WANTED
    expected: list[tuple[int, int]] = []
    num_waiting = version = 0

    def turn() -> None:
        assert len(calls) == min(num_waiting, 1)
        publisher._send_waiting()
        calls.clear()

    def use_parameters() -> None:
        frame = CoordinateFrame(f"frame{version}")
        publisher.set_parameters(ServerParameters(b"", 1, version, parsed=Parameters(), frame=frame))

    publisher.open()
    use_parameters()
    num_waiting = 2
    turn()
    [markers] = [each for each in server._channels.values() if each.topic.name == "/lab/markers"]
    subscriber: Any = viewer
    server._subscribe(subscriber, 1, markers.number)
    num_waiting = 0
    for utime, step in enumerate([*schedule, "turn"]):
        if step == "turn":
            turn()
            num_waiting = 0
            assert viewer.received == expected
            continue
        num_waiting += 1
        if step == "parameters":
            version += 1
            use_parameters()
        else:
            components = frozenset({MARKERS}) if step == "fewer" else WANTED
            publisher.publish(LAYOUTS[step != "first"], Stamp(utime, utime, 1, 1), components)
            expected.append((utime, version))
