"""The section ``ros2`` of the configuration: the names of tools."""

from typing import Any

import pytest

from gateway.outputs.adapters.ros2.settings import Ros2Settings
from tests.support.configurations import mistakes

HAND = {"name": "hand"}
LINK = {"child_frame": "hand_link"}


def test_tools_are_renamed_or_left_out_by_source_and_label() -> None:
    """Sources may have tools with one label and one name: their topics differ."""
    both = {"lab": {"Tool 1": HAND | LINK, "Tool 2": False}, "hall-2": {"Tool 1": HAND}}
    settings = Ros2Settings.model_validate({"tools": both})
    assert settings.tools["lab"]["Tool 2"] is False
    hand = settings.tools["lab"]["Tool 1"]
    assert hand
    assert (hand.name, hand.child_frame) == ("hand", "hand_link")
    assert Ros2Settings.model_validate(settings.model_dump(mode="json")) == settings
    assert (Ros2Settings().tf, Ros2Settings().tools) == (True, {})


@pytest.mark.parametrize(
    ("tools", "place"),
    [
        *(
            ({"lab": {"a": {"name": name}}}, "tools.lab.a.name")
            for name in ("", "2nd", "_hand", "a__b", "a_", "left hand", "a/b", "Fuß", "force_1", "x" * 64, 1)
        ),
        *(
            ({"lab": {"a": {"child_frame": frame}}}, "tools.lab.a.child_frame")
            for frame in ("", "/hand", "a b", "lab/hand", "lab", "x" * 65)
        ),
        ({"lab": {"a": HAND, "b": HAND}}, "tools.lab.b.name"),
        ({"lab": {"a": LINK}, "hall": {"a": LINK}}, "tools.hall.a.child_frame"),
        ({"lab": {"a": True}}, "tools.lab.a"),
        ({"lab": {"a": {"offset": {"translation_m": [1, 2]}}}}, "tools.lab.a.offset.translation_m"),
        (
            {"lab": {"a": {"offset": {"rotation_xyzw": [0, 0, 0, 1], "rotation_deg": {"yaw": 1}}}}},
            "tools.lab.a.offset.rotation_deg",
        ),
        ({"lab": {"a": None}}, "tools.lab.a"),
        ({"lab": {"a": {"nmae": "hand"}}}, "tools.lab.a.nmae"),
        ({"lab": {"": HAND}}, "tools.lab"),
        ({"lab": {"x" * 201: HAND}}, "tools.lab"),
        ({"lab": []}, "tools.lab"),
        ({"a lab": {}}, "tools"),
        ([], "tools"),
    ],
)
def test_names_that_ros_refuses_or_that_two_tools_have_are_mistakes(tools: Any, place: str) -> None:
    [(key, _)] = mistakes(Ros2Settings, {"tools": tools})
    assert key.startswith(place)
