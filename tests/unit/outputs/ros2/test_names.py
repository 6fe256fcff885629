"""Names that ROS 2 accepts, from any label."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.outputs.ros2.names import MAX_PART_CHARS, ros_name, unique_ros_names

# rmw_validate_full_topic_name, the rules of design.ros2.org, and no leading underscore, which hides a topic.
VALID_PART = re.compile("[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*")


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("wand", "wand"),
        ("Left Foot", "Left_Foot"),
        ("hall-2", "hall_2"),
        ("a__b", "a_b"),
        (" _x_ ", "x"),
        ("2nd", "tool_2nd"),
        ("Füße/été", "Fu_e_ete"),
        ("", "tool"),
        ("手", "tool"),
        ("*/**", "tool"),
        ("x" * 300, "x" * 48),
        ("x" * 47 + " y", "x" * 47),
        ("e\u0301te\u0301", "ete"),
    ],
)
def test_a_name(label: str, name: str) -> None:
    assert ros_name(label, "tool") == name


def test_names_are_different_and_unusable_labels_are_called_by_position() -> None:
    labels = ["Tool 1", "Tool-1", "手", "足", "tool_3", "Tool_1"]
    assert unique_ros_names(labels, "tool") == (
        *("Tool_1", "Tool_1_2", "tool_3", "tool_4", "tool_3_2", "Tool_1_3"),
    )


@given(st.lists(st.text(max_size=80) | st.sampled_from(["", "a", "a_2", "1", "tool", "tool_1"]), max_size=40))
def test_all_names_are_valid_and_different(labels: list[str]) -> None:
    names = unique_ros_names(labels, "tool")
    assert len(set(names)) == len(names) == len(labels)
    for name in names:
        assert VALID_PART.fullmatch(name), name
        assert len(name) <= MAX_PART_CHARS


def test_many_equal_labels_are_numbered() -> None:
    names = unique_ros_names(["x" * 100] * 256, "tool")
    assert names[-1] == "x" * 48 + "_256"
