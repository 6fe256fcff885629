"""The history makes the messages of frames again when somebody asks: exactly those that were published."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.encode import Stamp, encode_message
from gateway.messages.history import MessageHistory, WantedMessages, utime_of
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, SHORT_EVENT, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import FrameReader, RawFrame, encode_frame
from tests.support.clocks import Clock
from tests.support.toy_output import ToyOutput
from tests.unit.publish.rig import ALL, EVENT, MARKERS, TOOLS

LAYOUTS: Final = (
    (MARKERS, TOOLS),
    (MARKERS,),
    (EVENT, MARKERS),
    (TOOLS, MARKERS, TOOLS),  # a server may repeat a component
    (),
)
WANTED: Final = (ALL, frozenset({MARKERS}), ALL - {EVENT}, frozenset({EVENT}))
READERS: Final[dict[ByteOrder, FrameReader]] = {"big": FrameReader("big"), "little": FrameReader("little")}


def random_frame(number: int, types: Sequence[ComponentType], order: ByteOrder) -> RawFrame:
    """Return a frame whose items differ from those of other frames, and of other components in it."""
    components = []
    for place, each in enumerate(types):
        items = np.zeros(2, SHORT_EVENT if each is EVENT else ITEM_DTYPES[each])
        items[items.dtype.names[0]] = 10 * number + place
        components.append(encode_component(each, number, 100 * number, items, order))
    return READERS[order].read(encode_frame(components, order))


operations = st.tuples(
    st.sampled_from(["publish", "publish", "skip"]),
    st.sampled_from(LAYOUTS),
    st.sampled_from(WANTED),
    st.sampled_from(["big", "big", "little"]),
    # What happens before each frame of the operation.
    st.lists(st.sampled_from(["", "", "", "session", "version", "forget", "block"]), max_size=4),
)


def expected(
    model: dict[str, list[bytes]], frame: RawFrame, stamp: Stamp, wanted: frozenset[ComponentType]
) -> list[bytes]:
    """Add the messages of a frame to the model, and return them."""
    messages = []
    for component in frame.components:
        if component.type in wanted:
            kept = model.setdefault(component.type.key, [])
            messages.append(encode_message(component, stamp, len(kept)))
            kept.append(messages[-1])
    return messages


@given(
    st.lists(operations, max_size=40),
    st.booleans(),
    st.integers(0, 60),
    st.none() | st.integers(0, 60),
    st.integers(0, 400),
)
def test_the_history_and_the_newest_messages_are_those_of_a_plain_list(
    schedule: list[tuple[str, Sequence[ComponentType], frozenset[ComponentType], ByteOrder, list[str]]],
    is_paced: bool,
    first: int,
    last: int | None,
    since_utime: int,
) -> None:
    clock, output = Clock(), ToyOutput()
    output.max_rate_hz = {TOOLS: 1e4} if is_paced else {}
    fan_out = FanOut("lab", [output])
    fan_out.history = MessageHistory(clock)
    fan_out.history.set_limits(1000.0, 1 << 22)
    model: dict[str, list[bytes]] = {}
    published = []
    session = version = number = 0
    for operation, types, wanted, order, events in schedule:
        for event in events:
            session += event == "session"
            version += event == "version"
            if event == "forget":
                fan_out.forget_layouts()
            if event == "block":
                clock.now_s += 0.5
                fan_out.history.begin_block()
            number += 1
            frame = random_frame(number, types, order)
            stamp = Stamp(7 * number, 7 * number - 3, session, version)
            messages = expected(model, frame, stamp, wanted)
            published += messages if operation == "publish" else []
            (fan_out.publish if operation == "publish" else fan_out.skip)(frame, stamp, wanted)
    assert fan_out.frames == {each: len(model.get(each.key, ())) for each in ComponentType}
    if not is_paced:
        assert [message for _, message in output.messages] == published
    assert fan_out.history.overview["keys"].keys() == model.keys()
    for key, messages in model.items():
        everything = fan_out.history.find(key, WantedMessages(0))
        assert everything is not None
        assert everything.messages == messages
        found = fan_out.history.find(key, WantedMessages(first, None, last))
        assert found is not None
        assert found.messages == messages[first : None if last is None else last + 1]
        found = fan_out.history.find(key, WantedMessages(None, since_utime))
        assert found is not None
        assert found.messages == [each for each in messages if utime_of(each) >= since_utime]
        newest = next(each for each in ComponentType if each.key == key)
        assert fan_out.newest(newest, "another") == messages[-1]


def test_frames_count_with_their_bytes_and_those_beyond_the_memory_are_dropped() -> None:
    fan_out = FanOut("lab", [])
    fan_out.history.set_limits(1000.0, 1_000_000)
    frame = random_frame(1, LAYOUTS[0], "big")
    for number in range(10_000):
        fan_out.publish(frame, Stamp(number, number, 1, 1), ALL)
        assert fan_out.history.num_bytes <= 1_050_000
    found = fan_out.history.find("6d", WantedMessages(9000))
    assert found is not None
    assert found.newest == 9999
    kept_bytes = (10_000 - found.oldest) * (len(frame.body) + 100)
    assert 800_000 < kept_bytes < 1_050_000
