"""Which source and key the channels of a take belong to."""

from pathlib import Path

import rtc3d

from gateway.takes.reader import TakeReader
from tests.takes import START_UTIME, Message, description, markers, write_take


def pose(channel: str) -> Message:
    message = rtc3d.tool_pose_t()
    message.utime = START_UTIME
    return channel, message.encode()


def keys(folder: Path, messages: list[Message]) -> list[tuple[str, str]]:
    reader = TakeReader(write_take(folder / "take.lcmlog", messages))
    return [(message.source, message.key) for message in reader.messages()]


def on(channel: str, message: Message) -> Message:
    return channel, message[1]


def test_sources_whose_channels_share_a_beginning_are_kept_apart(tmp_path: Path) -> None:
    messages = [
        description("lab"),
        description("lab-2"),
        markers(1, 0, source="lab"),
        markers(1, 0, source="lab_2"),
    ]
    assert keys(tmp_path, messages) == [("lab", "take"), ("lab-2", "take"), ("lab", "3d"), ("lab-2", "3d")]


def test_a_source_is_named_by_its_description_whatever_the_prefix(tmp_path: Path) -> None:
    described = rtc3d.take_t()
    described.utime, described.source = START_UTIME, "Hall-B"
    messages = [("MY_OWN_HALL_B_TAKE", described.encode()), on("MY_OWN_HALL_B_3D", markers(1, 0))]
    assert keys(tmp_path, messages)[1] == ("Hall-B", "3d")


def test_without_a_description_the_channel_names_the_source(tmp_path: Path) -> None:
    assert keys(tmp_path, [markers(1, 0, source="lab-2")]) == [("lab_2", "3d")]


def test_sources_of_one_name_under_two_prefixes_stay_two(tmp_path: Path) -> None:
    messages = [on("A_LAB_3D", markers(1, 0)), on("B_LAB_3D", markers(1, 0)), on("B_LAB_3D", markers(1, 1))]
    assert keys(tmp_path, messages) == [("lab", "3d"), ("b_lab", "3d"), ("b_lab", "3d")]


def test_poses_belong_to_the_longest_known_source(tmp_path: Path) -> None:
    messages = [
        markers(1, 0, source="lab"),
        markers(1, 0, source="lab-6d-x"),
        pose("MOCAP_LAB_6D_ARM_6D_TIP"),
        pose("MOCAP_LAB_6D_X_6D_HAND"),
        pose("MOCAP_NEW_6D_HAND"),
    ]
    assert keys(tmp_path, messages)[2:] == [
        ("lab", "6d/ARM_6D_TIP"),
        ("lab_6d_x", "6d/HAND"),
        ("new", "6d/HAND"),
    ]


def test_a_pose_on_a_foreign_channel_is_unknown(tmp_path: Path) -> None:
    reader = TakeReader(write_take(tmp_path / "take.lcmlog", [markers(1, 0), pose("ARM")]))
    assert len(list(reader.messages())) == 1
    assert reader.unknown == {"ARM": 1}
