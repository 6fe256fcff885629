import re
from urllib.parse import unquote

import zenoh
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.topics import escape_key_chunk, lcm_channel, unique_name, zenoh_key

labels = st.text(max_size=80)


@given(labels)
def test_any_label_becomes_one_chunk_of_a_valid_zenoh_key(label: str) -> None:
    key = zenoh.KeyExpr(zenoh_key("mocap", "lab", "6d", label))
    assert len(str(key).split("/")) == 4
    assert not key.includes("mocap/lab/6d/another")


@given(labels)
def test_a_label_can_be_read_back_from_its_key(label: str) -> None:
    chunk = escape_key_chunk(label)
    assert unquote(chunk) == label or (label, chunk) == ("", "%")


@given(st.from_regex(r"[A-Za-z0-9_]{1,16}", fullmatch=True), labels, labels)
def test_any_label_gives_a_valid_lcm_channel(prefix: str, source: str, label: str) -> None:
    channel = lcm_channel(prefix, source, "6d", label)
    assert re.fullmatch(re.escape(prefix) + "_[A-Z0-9_]+", channel)
    assert len(channel) <= 63


@given(st.lists(labels, max_size=30), st.integers(4, 63))
def test_unique_names_differ_and_keep_to_the_length(wanted: list[str], max_length: int) -> None:
    taken: list[str] = []
    for name in wanted:
        taken.append(unique_name(name, taken, max_length))
    assert len(set(taken)) == len(wanted)
    assert all(len(name) <= max_length for name in taken)


@given(labels, st.sets(labels))
def test_a_free_name_is_not_changed(name: str, taken: set[str]) -> None:
    assert unique_name(name, taken - {name}, max_length=80) == name
