import pytest

from gateway.messages.topics import escape_key_chunk, lcm_channel, unique_name, zenoh_key


@pytest.mark.parametrize(
    ("path", "key", "channel"),
    [
        (("3d",), "mocap/lab/3d", "MOCAP_LAB_3D"),
        (("6d",), "mocap/lab/6d", "MOCAP_LAB_6D"),
        (("analog",), "mocap/lab/analog", "MOCAP_LAB_ANALOG"),
        (("force",), "mocap/lab/force", "MOCAP_LAB_FORCE"),
        (("event",), "mocap/lab/event", "MOCAP_LAB_EVENT"),
        (("status",), "mocap/lab/status", "MOCAP_LAB_STATUS"),
        (("6d", "Probe"), "mocap/lab/6d/Probe", "MOCAP_LAB_6D_PROBE"),
        (("6d", "tool 1"), "mocap/lab/6d/tool%201", "MOCAP_LAB_6D_TOOL_1"),
    ],
)
def test_keys_and_channels_are_as_documented(path: tuple[str, ...], key: str, channel: str) -> None:
    assert zenoh_key("mocap", "lab", *path) == key
    assert lcm_channel("MOCAP", "lab", *path) == channel


@pytest.mark.parametrize(
    ("label", "chunk"),
    [
        ("Probe_1.a-b~", "Probe_1.a-b~"),
        ("a/b", "a%2Fb"),
        ("*", "%2A"),
        ("a$*b", "a%24%2Ab"),
        ("what?#1", "what%3F%231"),
        ("@adv", "%40adv"),
        ("100%", "100%25"),
        ("Fuß", "Fu%C3%9F"),
        ("膝", "%E8%86%9D"),
        ("", "%"),
    ],
)
def test_characters_that_zenoh_refuses_in_a_label_are_percent_escaped(label: str, chunk: str) -> None:
    assert escape_key_chunk(label) == chunk


@pytest.mark.parametrize(
    ("label", "part"),
    [
        ("left foot", "LEFT_FOOT"),
        ("(left) -- foot!", "LEFT_FOOT"),
        ("Fuß links", "FUSS_LINKS"),
        ("膝", "_"),
        ("", "_"),
    ],
)
def test_characters_that_lcm_refuses_in_a_label_become_one_underscore(label: str, part: str) -> None:
    assert lcm_channel("MOCAP", "lab", "6d", label) == f"MOCAP_LAB_6D_{part}"


@pytest.mark.parametrize(
    ("taken", "unique"),
    [
        (set(), "PROBE"),
        ({"PROB"}, "PROBE"),
        ({"PROBE"}, "PROBE_2"),
        ({"PROBE", "PROBE_2", "PROBE_4"}, "PROBE_3"),
    ],
)
def test_a_taken_name_gets_the_first_free_number(taken: set[str], unique: str) -> None:
    assert unique_name("PROBE", taken) == unique


def test_a_long_name_is_cut_so_that_its_number_fits() -> None:
    assert unique_name(70 * "A", set()) == 63 * "A"
    assert unique_name(70 * "A", {63 * "A"}) == 61 * "A" + "_2"
    assert unique_name("ABCDE", {"ABCDE"}, max_length=5) == "ABC_2"
