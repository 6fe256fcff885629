"""The output of ``take list``, whatever a gateway replies."""

import io
from typing import Any

import pytest
from rich.console import Console

from gateway.cli.take_list import ListedTake, size_text, write_list

TAKE = {"name": "walk-1", "bytes": 3_456_789, "begin_utime": 1_700_000_000_000_000, "seconds": 83.25}


def written(**content: Any) -> str:
    out = io.StringIO()
    write_list({"lab": content}, Console(file=out, width=120))
    return out.getvalue()


def test_a_row_has_what_matters() -> None:
    text = written(takes=[TAKE | {"is_running": True, "lost": 3}], num_takes=1, kept_s=59.7)
    for part in ("lab", "walk-1", "1 min 23.2 s", "3.5 MB", "running, 3 messages lost"):
        assert part in text
    assert "lab: the last 60 s are kept, to be saved with: take save" in text


def test_no_takes_are_no_table() -> None:
    assert written(takes=[], num_takes=0, kept_s=0.0) == "lab: no takes\n"


def test_a_list_with_a_limit_says_so() -> None:
    assert "lab: the newest 1 of 1500 takes" in written(takes=[TAKE], num_takes=1500)


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"takes": 5, "num_takes": "x", "kept_s": None},
        {"takes": [5, None, {}, {"name": "\x1b[2J", "bytes": "x", "begin_utime": 1e300, "seconds": 1e299}]},
        {"takes": [{"name": "x" * 10_000, "begin_utime": -5, "seconds": float("nan")}]},
    ],
)
def test_what_another_gateway_sends_is_shown_as_far_as_possible(content: Any) -> None:
    assert "\x1b[2J" not in written(**content)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0.0 s"), (59.96, "1 min 0.0 s"), (3600.04, "1 h 0 min 0.0 s"), (7384.5, "2 h 3 min 4.5 s")],
)
def test_durations(seconds: float, text: str) -> None:
    assert ListedTake({"seconds": seconds}).duration_text == text


@pytest.mark.parametrize(
    ("num_bytes", "text"), [(0, "0 bytes"), (999, "999 bytes"), (1000, "1.0 kB"), (2.5e9, "2.5 GB")]
)
def test_sizes(num_bytes: float, text: str) -> None:
    assert size_text(num_bytes) == text
