"""Text from a network, as it reaches a log, a terminal or a status message."""

import json

from hypothesis import given
from hypothesis import strategies as st

from gateway.runtime.safe_text import quoted, safe_json, safe_lines, safe_text


def test_what_is_not_printable_is_escaped() -> None:
    for text in ("Lab 3, Ä µ 手", "C:\\takes", "'\""):
        assert safe_text(text) == text
    for text, shown in (
        ("a\0b\n2026 ERROR forged\r\t", r"a\x00b\n2026 ERROR forged\r\t"),
        ("\x1b[2J\x9b31m\x7f", r"\x1b[2J\x9b31m\x7f"),
        ("\u2028\u2029\u202e\u2066\u200b\ufeff", r"\u2028\u2029\u202e\u2066\u200b\ufeff"),
        ("\ud800 \U000e0001", r"\ud800 \U000e0001"),
    ):
        assert safe_text(text) == shown


def test_the_result_has_at_most_the_wanted_length() -> None:
    texts = ("abcd", "abcde", "\x1b\x1b", "")
    assert [safe_text(text, 4) for text in texts] == ["abcd", "abc…", r"\x1…", ""]


@given(st.text(st.characters(), max_size=40), st.integers(1, 50))
def test_any_text_becomes_one_bounded_line_that_stays_as_it_is(text: str, max_characters: int) -> None:
    safe = safe_text(text, max_characters)
    assert safe.isprintable()
    assert len(safe) <= max_characters
    assert safe.encode().decode() == safe
    assert safe_text(safe, max_characters) == safe


def test_lines_stay_separate() -> None:
    assert safe_lines("Traceback:\n  \x1b[2J\r\nend\u2028") == "Traceback:\n  \\x1b[2J\\r\nend\\u2028"
    assert len(safe_lines("\x1b\n" * 30_000, 1000)) < 1000 * 10


def test_quoted_text_is_bounded_and_escaped() -> None:
    assert quoted("a'b\n") == r'''"a'b\n"'''
    assert quoted("x" * 41) == "'" + "x" * 40 + "…'"
    assert quoted("x" * 60, 60) == "'" + "x" * 60 + "'"


@given(
    st.recursive(
        st.text(st.characters()), lambda values: st.lists(values) | st.dictionaries(st.text(), values)
    )
)
def test_json_keeps_its_values(value: object) -> None:
    text = safe_json(json.dumps(value, ensure_ascii=False, indent=1))
    assert text.replace("\n", "").isprintable()
    assert json.loads(text) == json.loads(json.dumps(value))
