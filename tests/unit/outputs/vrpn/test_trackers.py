"""The names and numbers of trackers."""

from gateway.outputs.vrpn.trackers import MAX_TRACKERS, Tracker, Trackers


def names(trackers: Trackers, source: str) -> list[str]:
    return ["" if tracker is None else tracker.name for tracker in trackers.of_source(source).values()]


def test_tools_of_the_only_source_give_the_names() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand", "Left Foot", "a@b", "Füße-2.1"])
    assert names(trackers, "lab") == ["wand", "Left_Foot", "a_b", "Füße-2.1"]


def test_several_sources_are_in_the_names() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    trackers.set_tools("stage", [])  # a source that has told nothing yet is one, too
    assert names(trackers, "lab") == ["lab/wand"]
    trackers.set_tools("stage", ["wand", "foot"])
    assert names(trackers, "stage") == ["stage/wand", "stage/foot"]


def test_name_without_source_returns_when_the_other_source_is_removed() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    trackers.set_tools("stage", ["wand"])
    trackers.remove("lab")
    assert names(trackers, "stage") == ["wand"]
    trackers.remove("lab")  # again
    assert names(trackers, "lab") == []


def test_names_with_the_source_always() -> None:
    trackers = Trackers("source/tool")
    trackers.set_tools("lab", ["wand"])
    assert names(trackers, "lab") == ["lab/wand"]


def test_names_without_the_source_while_they_are_different() -> None:
    trackers = Trackers("tool")
    trackers.set_tools("lab", ["wand", "foot"])
    trackers.set_tools("stage", ["wand", "hand"])
    assert names(trackers, "lab") == ["wand", "foot"]
    assert names(trackers, "stage") == ["stage/wand", "hand"]


def test_names_that_become_equal_are_numbered() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["w nd", "w@nd", "w\tnd", "w_nd"])
    assert names(trackers, "lab") == ["w_nd", "w_nd_2", "w_nd_3", "w_nd_4"]


def test_long_names_are_cut_between_characters() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["ü" * 60, "ü" * 61])
    assert names(trackers, "lab") == ["ü" * 47, "ü" * 46 + "_2"]


def test_tool_keeps_its_tracker_while_it_comes_and_goes() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand", "foot"])
    before = dict(trackers.of_source("lab"))
    trackers.set_tools("lab", ["hand"])
    trackers.set_tools("lab", ["foot", "hand", "wand"])
    after = trackers.of_source("lab")
    assert {tool: after[tool] for tool in ("wand", "foot")} == before
    assert after["hand"] == Tracker(2, "hand")


def test_only_present_tools_have_a_name() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    trackers.set_tools("lab", ["foot"])
    assert trackers.named("wand") is None
    assert trackers.named("foot") == Tracker(1, "foot")


def test_version_grows_with_each_change_only() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    version = trackers.version
    trackers.set_tools("lab", ["wand"])
    assert trackers.version == version
    trackers.set_tools("lab", ["foot"])
    assert trackers.version > version


def test_former_tools_make_room_for_new_ones() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", ["wand"])
    for first in range(0, 5 * MAX_TRACKERS, 100):
        trackers.set_tools("lab", ["wand", *(f"tool {number}" for number in range(first, first + 100))])
        assert "" not in names(trackers, "lab")
    assert trackers.named("wand") == Tracker(0, "wand")
    assert {tracker.number for tracker in trackers.current} <= set(range(MAX_TRACKERS))


def test_tools_beyond_the_limit_get_no_tracker() -> None:
    trackers = Trackers("auto")
    trackers.set_tools("lab", [f"tool {number}" for number in range(MAX_TRACKERS + 3)])
    assert names(trackers, "lab")[MAX_TRACKERS - 1 :] == [f"tool_{MAX_TRACKERS - 1}", "", "", ""]
    assert len(list(trackers.current)) == MAX_TRACKERS
    trackers.set_tools("lab", ["wand"])
    assert names(trackers, "lab") == ["wand"]


def test_the_tool_that_has_been_away_longest_makes_room_first() -> None:
    """A tool that came back keeps its number longer than one that has only gone."""
    trackers = Trackers("tool")
    for tools in (["a"], ["b"], ["a"], [f"tool {number}" for number in range(MAX_TRACKERS - 1)], ["a"]):
        trackers.set_tools("lab", tools)
    assert [each.number for each in trackers.current] == [0]
