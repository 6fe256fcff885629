"""Markers and tools by visibility, and the newest events."""

import time

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.view.item_tables import MAX_ROWS, events_html, items_html, worst_first
from tests.unit.view.live_lab import NAN, Lab
from tests.unit.view.test_source_text import text_of
from tests.unit.view.test_state_text import wait

LABELS = """<The_3D><Markers>3</Markers>
<Marker><Label>LASI</Label></Marker>
<Marker><Label>RASI</Label></Marker>
<Marker><Label>&lt;img src=x onerror=alert(1)&gt;</Label></Marker>
</The_3D>"""


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_the_least_visible_come_first() -> None:
    assert worst_first(np.array([1, 0.5, 1, 0, 0.5])) == [3, 1, 4, 0, 2]


def test_markers_by_visibility(lab: Lab) -> None:
    lab.send_parameters(LABELS)
    for number in range(4):
        lab.send_markers(True, number == 0, number > 0)
    text = text_of(items_html(lab.source))
    assert "|3 markers|visible, last 10 s|" in text
    assert "|RASI|25.0 %|&lt;img src=x onerror=alert(1)&gt;|75.0 %|LASI|100 %|" in text


def test_tools_with_their_error(lab: Lab) -> None:
    lab.send(ComponentType.TOOLS, [(1, 0, 0, 0, 1, 2, 3, 0.1234), (NAN,) * 8])
    assert "|tool 2|0 %|–|tool 1|100 %|0.123 mm|" in text_of(items_html(lab.source))


def test_rows_are_bounded(lab: Lab) -> None:
    lab.send_parameters(
        "<The_3D><Markers>10000</Markers>"
        + "".join(f"<Marker><Label>{'&lt;' * 200}{number}</Label></Marker>" for number in range(10_000))
        + "</The_3D>"
    )
    lab.send_markers(*[number > 10 for number in range(10_000)])
    html = items_html(lab.source)
    assert html.count("<tr>") == MAX_ROWS + 1
    assert "9,960 more markers, always visible" in html
    assert len(html) < 30_000


def test_markers_beyond_the_rows_that_are_not_always_visible(lab: Lab) -> None:
    lab.send_markers(*[False] * MAX_ROWS, False, True)
    lab.send_markers(*[False] * MAX_ROWS, True, True)
    assert "2 more markers, visible in at least 50.0 % of the frames" in items_html(lab.source)


def test_markers_that_stopped_long_ago(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True, True)
    source = lab.source
    wait(monkeypatch, 11)
    assert "2 markers, no frames in the last 10 s" in items_html(source)


def test_the_number_of_markers_changes(lab: Lab) -> None:
    lab.send_markers(True, True)
    lab.send_markers(True, False, True)
    lab.send_markers(True, False, True, True)
    lab.send_markers(True)
    assert "marker" in items_html(lab.source)
    lab.send_markers()
    assert "0 markers, no frames in the last 10 s" in items_html(lab.source)


def test_a_source_without_markers(lab: Lab) -> None:
    lab.send(ComponentType.ANALOG, [1.0])
    assert "no markers and no tools" in items_html(lab.source)


def test_events_the_newest_first(lab: Lab) -> None:
    now = time.time_ns() // 1000
    for number in range(30):
        lab.send(ComponentType.EVENT, [(number, 0, 7, -1, -1)], utime=now)
    html = events_html(lab.source)
    text = text_of(html)
    assert html.count("<tr>") == 21
    assert text.index("|event 29|param1: 7|") < text.index("|event 10|")
    assert "|event 9|" not in text


def test_no_events(lab: Lab) -> None:
    lab.send_markers(True)
    assert "no events yet" in events_html(lab.source)
