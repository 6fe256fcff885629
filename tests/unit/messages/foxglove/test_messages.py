"""Messages of the Foxglove schemas from items of frames."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.foxglove.messages import FoxgloveSource
from gateway.messages.foxglove.topics import FloatTopics, field_names
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from tests.support.parameters import ALL

UTIME = 1_700_000_000_000_000
FRAME = CoordinateFrame("lab", 1e-3, (0.0, 0.0, 0.6, 0.8), (1.0, 2.0, 3.0))


@pytest.mark.parametrize("bits", ["7f800000", "7f800001", "7f7fffff", "ffffffff"])
@pytest.mark.parametrize("component", [each for each in ITEM_DTYPES if each is not ComponentType.EVENT])
def test_any_bits_are_converted_without_a_warning(component: ComponentType, bits: str) -> None:
    """Infinity, a signalling NaN, the largest number, and out of view; warnings are errors in tests."""
    source = FoxgloveSource(FloatTopics("lab", is_live=True), ALL, 1, CoordinateFrame("lab", 1e6))
    dtype = ITEM_DTYPES[component]
    items = np.frombuffer(bytes.fromhex(bits) * (2 * dtype.itemsize // 4), dtype)
    topics = source.topics(component, len(items))
    found = [*source.convert_frames(component, items[None], [1_700_000_000_000_000], [1000])]
    assert [each.topic for each in found] == [*topics]
    num_messages = 0 if component is ComponentType.TOOLS else 1  # the tools are out of view, or too far away
    assert [len(each.messages) for each in found] == [num_messages] * len(found)


@given(st.lists(st.text(st.sampled_from("aZ019_ -Üé漢")) | st.text(), max_size=5))
def test_every_viewer_accepts_the_fields_of_ros_messages(labels: list[str]) -> None:
    """@foxglove/rosmsg and @lichtblick/rosmsg refuse the whole topic because of one name."""
    records = FloatTopics("lab", is_live=True).records("analog", field_names(labels, "channel"))
    names = [line.split()[1] for line in records[1].topic.schema.decode().splitlines()]
    assert len(set(names)) == len(labels)
    assert all(re.fullmatch("[a-z](?:_?[a-z0-9]+)*", name) for name in names)


_NUMBERS = st.sampled_from((0.0, 1.0, -2.5, 20.0, 1e30, float("inf"), float("nan")))


@given(st.data())
def test_frames_that_are_converted_together_become_the_same_messages_as_alone(data: st.DataObject) -> None:
    """Whatever is out of view in one of them."""
    source = FoxgloveSource(FloatTopics("lab", is_live=True), ALL, 1, FRAME)
    component = data.draw(st.sampled_from([*ITEM_DTYPES]))
    shape = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 3))
    items = np.zeros(shape, ITEM_DTYPES[component])
    for field in items.dtype.names or ():
        numbers = _NUMBERS if items.dtype[field].kind == "f" else st.integers(0, 2**31)
        items[field] = np.array(
            data.draw(st.lists(numbers, min_size=items.size, max_size=items.size))
        ).reshape(shape)
    utimes = [UTIME + 1000 * number for number in range(len(items))]
    stamps_us = [1000 * number for number in range(len(items))]
    found = [
        (topic, frame, utime, message)
        for topic, *each in source.convert_frames(component, items, utimes, stamps_us)
        for utime, message, frame in zip(*each, strict=True)
    ]
    alone = [
        (topic, frame, utime, message)
        for frame in range(len(items))
        for topic, times, messages, _ in source.convert_frames(
            component, items[frame : frame + 1], utimes[frame : frame + 1], stamps_us[frame : frame + 1]
        )
        for utime, message in zip(times, messages, strict=True)
    ]
    assert sorted(found) == sorted(alone)
