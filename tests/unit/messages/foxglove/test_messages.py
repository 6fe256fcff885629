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


@pytest.mark.parametrize("bits", ["7f800000", "7f800001", "7f7fffff", "ffffffff"])
@pytest.mark.parametrize("component", [each for each in ITEM_DTYPES if each is not ComponentType.EVENT])
def test_any_bits_are_converted_without_a_warning(component: ComponentType, bits: str) -> None:
    """Infinity, a signalling NaN, the largest number, and out of view; warnings are errors in tests."""
    source = FoxgloveSource(FloatTopics("lab", is_live=True), ALL, 1, CoordinateFrame("lab", 1e6))
    dtype = ITEM_DTYPES[component]
    items = np.frombuffer(bytes.fromhex(bits) * (2 * dtype.itemsize // 4), dtype)
    topics = source.topics(component, len(items))
    messages = source.convert(component, items, 1_700_000_000_000_000, 1000, topics)
    assert {message.topic for message in messages} <= set(topics)  # none for tools out of view


@given(st.lists(st.text(st.sampled_from("aZ019_ -Üé漢")) | st.text(), max_size=5))
def test_every_viewer_accepts_the_fields_of_ros_messages(labels: list[str]) -> None:
    """@foxglove/rosmsg and @lichtblick/rosmsg refuse the whole topic because of one name."""
    records = FloatTopics("lab", is_live=True).records("analog", field_names(labels, "channel"))
    names = [line.split()[1] for line in records[1].topic.schema.decode().splitlines()]
    assert len(set(names)) == len(labels)
    assert all(re.fullmatch("[a-z](?:_?[a-z0-9]+)*", name) for name in names)
