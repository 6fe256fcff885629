"""The log of changes in the numbers of items."""

import logging

import pytest

from gateway.publish.item_counts import ItemCounts
from gateway.rtc3d.components import ComponentType

MARKERS, TOOLS = ComponentType.MARKERS, ComponentType.TOOLS


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def test_a_change_counts_only_within_a_session() -> None:
    counts = ItemCounts("lab")
    assert not counts.update({MARKERS: 2}, 1)
    assert counts.update({MARKERS: 3}, 1)
    assert not counts.update({MARKERS: 4}, 2)
    assert not counts.update({TOOLS: 1}, 2)
    assert counts.update({MARKERS: 4, TOOLS: 2}, 2)
    assert counts.update({MARKERS: 5, TOOLS: 2}, 2)


def test_a_server_that_changes_its_number_all_the_time_does_not_fill_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    clock = Clock()
    counts = ItemCounts("lab", clock)
    for number in range(1001):
        counts.update({MARKERS: number % 2, TOOLS: 1}, 1)
    changed = "lab: number of items in 3d changed from"
    assert caplog.messages == [f"{changed} 0 to 1"]
    counts.check()
    clock.now_s += 30
    counts.check()
    counts.check()
    assert caplog.messages[1:] == [f"{changed} 1 to 0, after 999 changes"]
    clock.now_s += 30
    counts.update({MARKERS: 7}, 1)
    assert caplog.messages[2:] == [f"{changed} 0 to 7"]
