"""The names and numbers of trackers."""

import pytest

from gateway.outputs.adapters.vrpn.trackers import MAX_TRACKERS, Tracker, TrackerNames, Trackers


def names(trackers: Trackers, source: str = "lab") -> list[str]:
    return ["" if tracker is None else tracker.name for tracker in trackers.of_source(source).values()]


@pytest.mark.parametrize(
    ("style", "tools", "expected"),
    [
        pytest.param(
            "auto", ["wand", "Left Foot", "a@b", "Füße-2.1"], ["wand", "Left_Foot", "a_b", "Füße-2.1"]
        ),
        pytest.param("source/tool", ["wand"], ["lab/wand"]),
        pytest.param("auto", ["w nd", "w@nd", "w_nd"], ["w_nd", "w_nd_2", "w_nd_3"], id="alike"),
        pytest.param("auto", ["ü" * 60, "ü" * 61], ["ü" * 47, "ü" * 46 + "_2"], id="cut between characters"),
    ],
)
def test_names_of_the_tools_of_one_source(style: TrackerNames, tools: list[str], expected: list[str]) -> None:
    trackers = Trackers(style)
    trackers.set_tools("lab", tools)
    assert names(trackers) == expected


def test_the_source_is_in_the_names_while_there_are_several() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    trackers.set_tools("stage", [])  # a source that has told nothing yet is one, too
    assert names(trackers) == ["lab/wand"]
    trackers.set_tools("stage", ["wand", "foot"])
    assert names(trackers, "stage") == ["stage/wand", "stage/foot"]
    for _ in range(2):
        trackers.remove("lab")
        assert (names(trackers), names(trackers, "stage")) == ([], ["wand", "foot"])


def test_names_without_the_source_while_they_are_different() -> None:
    trackers = Trackers("tool")
    trackers.set_tools("lab", ["wand", "foot"])
    trackers.set_tools("stage", ["wand", "hand"])
    assert (names(trackers), names(trackers, "stage")) == (["wand", "foot"], ["stage/wand", "hand"])


def test_tool_keeps_its_tracker_while_it_comes_and_goes() -> None:
    """Only a present one is found by its name, and the version grows with each change only."""
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand", "foot"])
    before, version = dict(trackers.of_source("lab")), trackers.version
    trackers.set_tools("lab", ["wand", "foot"])
    assert trackers.version == version
    trackers.set_tools("lab", ["hand"])
    assert trackers.version > version
    assert (trackers.by_name.get("wand"), trackers.by_name.get("hand")) == (None, Tracker(2, "hand"))
    trackers.set_tools("lab", ["foot", "hand", "wand"])
    assert trackers.of_source("lab") == {**before, "hand": Tracker(2, "hand")}


def test_former_tools_make_room_for_new_ones() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    for first in range(0, 5 * MAX_TRACKERS, 100):
        trackers.set_tools("lab", ["wand", *(f"tool {number}" for number in range(first, first + 100))])
        assert "" not in names(trackers)
    assert trackers.by_name.get("wand") == Tracker(0, "wand")
    assert {tracker.number for tracker in trackers.by_name.values()} <= set(range(MAX_TRACKERS))


def test_tools_beyond_the_limit_get_no_tracker() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", [f"tool {number}" for number in range(MAX_TRACKERS + 3)])
    assert names(trackers)[MAX_TRACKERS - 1 :] == [f"tool_{MAX_TRACKERS - 1}", "", "", ""]
    assert len(trackers.by_name) == MAX_TRACKERS
    trackers.set_tools("lab", ["wand"])
    assert names(trackers) == ["wand"]


def test_the_tool_that_has_been_away_longest_makes_room_first() -> None:
    """A tool that came back keeps its number longer than one that has only gone."""
    trackers = Trackers("tool")
    for tools in (["a"], ["b"], ["a"], [f"tool {number}" for number in range(MAX_TRACKERS - 1)], ["a"]):
        trackers.set_tools("lab", tools)
    assert [each.number for each in trackers.by_name.values()] == [0]
