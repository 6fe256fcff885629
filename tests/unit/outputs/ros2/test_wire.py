"""Keys, tokens and attachments: those in the design document of rmw_zenoh, and hashes from rosbags."""

import pytest
from rosbags.typesys import Stores, get_typestore

from gateway.outputs.ros2.message_types import HUMBLE, POSE_STAMPED, ROS_TYPES, TF_MESSAGE, RosType
from gateway.outputs.ros2.wire import Node, QoS, SeenEntity, attachment, data_key, gid_of, seen_entity

STRING = RosType(
    "std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
SESSION = "8b20917502ee955ac4476e0266340d5c"


def test_keys_of_the_design_document() -> None:
    end = "chatter/std_msgs::msg::dds_::String_/" + STRING.type_hash
    assert data_key(0, "/chatter", STRING, STRING.type_hash) == f"0/{end}"
    assert data_key(0, "/robot1/chatter", STRING, STRING.type_hash) == f"0/robot1/{end}"


def test_tokens_of_the_design_document() -> None:
    node = Node(2, SESSION, "", "talker")
    assert node.token == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/talker"
    assert node.publisher_token(10, "/chatter", STRING, STRING.type_hash, QoS(True, 7)) == (
        f"@ros2_lv/2/{SESSION}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        f"{STRING.type_hash}/::,7:,:,:,,"
    )


def test_tokens_in_a_namespace() -> None:
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


def test_an_attachment_by_hand() -> None:
    gid = bytes(range(16))
    by_hand = bytes.fromhex("0100000000000000 e803000000000000 10 000102030405060708090a0b0c0d0e0f")
    assert attachment(1, 1000, gid) == by_hand


def test_the_gid_differs_for_each_token() -> None:
    assert len({gid_of(token) for token in ("a", "b", "c")}) == 3
    assert len(gid_of("a")) == 16


@pytest.mark.parametrize("ros_type", ROS_TYPES, ids=lambda ros_type: ros_type.name)
@pytest.mark.parametrize("store", [Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL])
def test_hashes_are_those_of_rosbags(ros_type: RosType, store: Stores) -> None:
    assert get_typestore(store).hash_rihs01(ros_type.name) == ros_type.type_hash
    assert ros_type.hash_in("jazzy") == ros_type.type_hash


def test_humble_has_no_hashes() -> None:
    assert POSE_STAMPED.hash_in(HUMBLE) == "TypeHashNotSupported"
