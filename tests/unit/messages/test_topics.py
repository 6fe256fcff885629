import pytest

from gateway.messages.topics import escape_key_chunk, lcm_channel, unique_name, zenoh_key


@pytest.mark.parametrize(
    ("path", "key", "channel"),
    [
        (("3d",), "mocap/lab/3d", "MOCAP_LAB_3D"),
        (("status",), "mocap/lab/status", "MOCAP_LAB_STATUS"),
        (("6d", "Probe"), "mocap/lab/6d/Probe", "MOCAP_LAB_6D_PROBE"),
        (("6d", "tool 1"), "mocap/lab/6d/tool%201", "MOCAP_LAB_6D_TOOL_1"),
    ],
)
def test_keys_and_channels_are_as_documented(path: tuple[str, ...], key: str, channel: str) -> None:
    assert (zenoh_key("mocap", "lab", *path), lcm_channel("MOCAP", "lab", *path)) == (key, channel)


@pytest.mark.parametrize(
    ("label", "chunk", "channel"),
    [
        ("Probe_1.a-b~", "Probe_1.a-b~", "PROBE_1_A_B"),
        *(("a/b", "a%2Fb", "A_B"), ("*", "%2A", "_"), ("a$*b", "a%24%2Ab", "A_B"), ("", "%", "_")),
        *(("what?#1", "what%3F%231", "WHAT_1"), ("100%", "100%25", "100"), ("@adv", "%40adv", "ADV")),
        *(("Fuß links", "Fu%C3%9F%20links", "FUSS_LINKS"), ("膝", "%E8%86%9D", "_")),
        ("(left) -- foot!", "%28left%29%20--%20foot%21", "LEFT_FOOT"),
    ],
)
def test_characters_that_are_refused_in_a_label_are_replaced(label: str, chunk: str, channel: str) -> None:
    """Zenoh's are percent-escaped, LCM's become one underscore."""
    assert escape_key_chunk(label) == chunk
    assert lcm_channel("MOCAP", "lab", "6d", label) == f"MOCAP_LAB_6D_{channel}"


@pytest.mark.parametrize(
    ("taken", "suffix"),
    [(set(), ""), ({"PROB"}, ""), ({"PROBE"}, "_2"), ({"PROBE", "PROBE_2", "PROBE_4"}, "_3")],
)
def test_a_taken_name_gets_the_first_free_number(taken: set[str], suffix: str) -> None:
    assert unique_name("PROBE", taken) == "PROBE" + suffix


def test_a_long_name_is_cut_so_that_its_number_fits() -> None:
    assert unique_name(70 * "A", set()) == 63 * "A"
    assert unique_name(70 * "A", {63 * "A"}) == 61 * "A" + "_2"
    assert unique_name("ABCDE", {"ABCDE"}, max_length=5) == "ABC_2"
