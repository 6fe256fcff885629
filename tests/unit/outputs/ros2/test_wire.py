"""Names, keys, tokens and attachments: those in the design document of rmw_zenoh; hashes from rosbags."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from gateway.outputs.ros2.message_types import HUMBLE, ROS_TYPES, TF_MESSAGE, RosType
from gateway.outputs.ros2.names import MAX_PART_CHARS, ros_name, unique_ros_names
from gateway.outputs.ros2.wire import Node, QoS, SeenEntity, attachment, data_key, gid_of, seen_entity

STRING = RosType(
    "std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
SESSION = "8b20917502ee955ac4476e0266340d5c"


def test_keys_and_tokens_of_the_design_document() -> None:
    end = f"std_msgs::msg::dds_::String_/{STRING.type_hash}"
    assert data_key(0, "/chatter", STRING, STRING.type_hash) == f"0/chatter/{end}"
    assert data_key(0, "/robot1/chatter", STRING, STRING.type_hash) == f"0/robot1/chatter/{end}"
    node = Node(2, SESSION, "", "talker")
    assert node.token == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/talker"
    token = node.publisher_token(10, "/chatter", STRING, STRING.type_hash, QoS(True, 7))
    assert token == f"@ros2_lv/2/{SESSION}/0/10/MP/%/%/talker/%chatter/{end}/::,7:,:,:,,"
    node = Node(0, SESSION, "site/mocap", "rtc3d_gateway")
    assert node.token == f"@ros2_lv/0/{SESSION}/0/0/NN/%/%site%mocap/rtc3d_gateway"
    token = node.publisher_token(1, "/tf", TF_MESSAGE, TF_MESSAGE.type_hash, QoS(False, 10))
    assert token == (
        f"@ros2_lv/0/{SESSION}/0/1/MP/%/%site%mocap/rtc3d_gateway/%tf/tf2_msgs::msg::dds_::TFMessage_/"
        f"{TF_MESSAGE.type_hash}/2::,10:,:,:,,"
    )


@pytest.mark.parametrize(
    ("token", "seen"),
    [
        ("@ros2_lv/0/abc/0/0/NN/%/%/talker", SeenEntity("/talker", False)),
        ("@ros2_lv/0/abc/0/0/NN/%/%a%b/talker", SeenEntity("/a/b/talker", False)),
        ("@ros2_lv/0/abc/0/1/MS/%/%/arm/%a%tf/T/H/q", SeenEntity("/arm", True, "/a/tf", "T", "H")),
        ("@ros2_lv/0/abc/0/1/MP/%/%/arm/%tf/T/H", SeenEntity("/arm", False, "/tf", "T", "H")),
        ("@ros2_lv/0/abc/0/1/MP/%/%/arm/%tf/T", None),
        ("@ros2_lv/0/abc/0/0/NN/%/%", None),
        ("", None),
    ],
)
def test_what_a_token_shows(token: str, seen: SeenEntity | None) -> None:
    """The doctor reads tokens of any program, so other formats must not disturb it."""
    assert seen_entity(token) == seen


def test_an_attachment_by_hand_and_gids_that_differ_for_each_token() -> None:
    by_hand = bytes.fromhex("0100000000000000 e803000000000000 10 000102030405060708090a0b0c0d0e0f")
    assert attachment(1, 1000, bytes(range(16))) == by_hand
    gids = {gid_of(token) for token in ("a", "b", "c")}
    assert [len(gid) for gid in gids] == [16] * 3


@pytest.mark.parametrize("ros_type", ROS_TYPES, ids=lambda ros_type: ros_type.name)
@pytest.mark.parametrize("store", [Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL])
def test_hashes_are_those_of_rosbags(ros_type: RosType, store: Stores) -> None:
    assert get_typestore(store).hash_rihs01(ros_type.name) == ros_type.type_hash
    assert ros_type.hash_in("jazzy") == ros_type.type_hash
    assert ros_type.hash_in(HUMBLE) == "TypeHashNotSupported"


# Names --------------------------------------------------------------------------------------

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
    assert unique_ros_names(["x" * 100] * 256, "tool")[-1] == "x" * 48 + "_256"


@given(st.lists(st.text(max_size=80) | st.sampled_from(["", "a", "a_2", "1", "tool", "tool_1"]), max_size=40))
def test_all_names_are_valid_and_different(labels: list[str]) -> None:
    names = unique_ros_names(labels, "tool")
    assert len(set(names)) == len(names) == len(labels)
    for name in names:
        assert VALID_PART.fullmatch(name), name
        assert len(name) <= MAX_PART_CHARS
