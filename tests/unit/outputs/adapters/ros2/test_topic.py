"""Names, keys, tokens and attachments: those in the design document of rmw_zenoh; hashes from rosbags."""

import re
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.ros2.encode import TF_MESSAGE, RosType
from gateway.messages.ros2.names import MAX_PART_CHARS, ros_name, unique_ros_names
from gateway.outputs.adapters.ros2.topic import (
    Node,
    QoS,
    SeenEntity,
    attachment,
    data_key,
    gid_of,
    seen_entity,
)

STRING = RosType(
    "std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
SESSION = "8b20917502ee955ac4476e0266340d5c"
TF_TOKEN = (
    f"@ros2_lv/0/{SESSION}/0/1/MP/%/%site%mocap/rtc3d_gateway/%tf/tf2_msgs::msg::dds_::TFMessage_/"
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087/2::,10:,:,:,,"
)


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
    assert token == TF_TOKEN


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
    by_hand = bytes.fromhex("0100000000000000 e803000000000000 10 000102030405060708090a0b0c0d0e0f")
    assert attachment(1, 1000, bytes(range(16))) == by_hand


@pytest.mark.parametrize(
    ("token", "low", "high"),
    [
        ("", 0x6001C324468D497F, 0x99AA06D3014798D8),  # published vectors of XXH3-128
        ("abc", 0x78AF5F94892F3950, 0x06B05AB6733A6185),
        (TF_TOKEN, 0x5FBD799F45817D90, 0xFD44188B2550BE05),  # by the Go module github.com/zeebo/xxh3
    ],
)
def test_gids_are_those_that_nodes_compute_from_the_token(token: str, low: int, high: int) -> None:
    """A node finds the publisher of a message in its graph by the gid."""
    assert gid_of(token) == struct.pack("<QQ", low, high)


@pytest.mark.parametrize(
    ("qos", "code"),
    [(QoS(True, 42), "::,:,:,:,,"), (QoS(False, 42), "2::,:,:,:,,"), (QoS(False, 43), "2::,43:,:,:,,")],
)
def test_defaults_of_rmw_zenoh_are_left_out_of_tokens(qos: QoS, code: str) -> None:
    """A node encodes a token anew before it hashes it; a default that is written changes the gid."""
    assert qos.code == code


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
        ("Füße/été", "Fusse_ete"),
        ("GROẞ Ærø Łódź", "GROSS_Aero_Lodz"),
        ("đ ð þ œ ħ ı", "d_d_th_oe_h_i"),
        ("Αγκώνας µ", "Agkonas_m"),
        ("Колено Щит объём", "Koleno_Shchit_obyem"),
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
    assert unique_ros_names(["Fuß", "Fuss", "Fu"], "tool") == ("Fuss", "Fuss_2", "Fu")
    assert unique_ros_names(["a", "b"], "tool", {"b": "a", "c": "a_2"}) == ("a_3", "a")
    assert unique_ros_names(["x" * 100] * 256, "tool")[-1] == "x" * 48 + "_256"


@given(st.lists(st.text(max_size=80) | st.sampled_from(["", "a", "a_2", "1", "tool", "tool_1"]), max_size=40))
def test_all_names_are_valid_and_different(labels: list[str]) -> None:
    names = unique_ros_names(labels, "tool")
    assert len(set(names)) == len(names) == len(labels)
    for name in names:
        assert VALID_PART.fullmatch(name), name
        assert len(name) <= MAX_PART_CHARS
