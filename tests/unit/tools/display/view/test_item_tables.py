"""Markers and tools by visibility, the newest events, and the channels that can be plotted."""

import re
import time

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.tools.display.live import DisplayedSource
from gateway.tools.display.view.plots import MAX_CHOICES, PlotChannel, choices, samples
from gateway.tools.display.view.texts import MAX_ROWS, events_html, items_html
from tests.support.takes import START_UTIME
from tests.unit.tools.display.live_lab import NAN, Lab, text_of, wait

LABELS = """<The_3D><Markers>3</Markers>
<Marker><Label>LASI</Label></Marker>
<Marker><Label>RASI</Label></Marker>
<Marker><Label>&lt;img src=x onerror=alert(1)&gt;</Label></Marker>
</The_3D>"""


def test_the_least_visible_come_first_and_equal_ones_in_their_order(lab: Lab) -> None:
    lab.send_markers(True, True, True, False, True)
    lab.send_markers(True, False, True, False, False)
    names = re.findall(r"marker \d", text_of(items_html(lab.source)))
    assert names == ["marker 4", "marker 2", "marker 5", "marker 1", "marker 3"]


def test_markers_by_visibility_and_tools_with_their_error(lab: Lab) -> None:
    lab.send(ComponentType.EVENT, [(1, 0, 7, -1, -1)])
    assert "no markers and no tools" in items_html(lab.source)
    lab.send_parameters(LABELS)
    for number in range(4):
        lab.send_markers(True, number == 0, number > 0)
    lab.send(ComponentType.TOOLS, [(1, 0, 0, 0, 1, 2, 3, 0.1234), (NAN,) * 8, (1, 0, 0, 0, 1, 2, 3, NAN)])
    text = text_of(items_html(lab.source))
    assert "|A name in|red|is missing in the newest frame." in text
    assert "|3 markers|visible, last 10 s|" in text
    assert "|RASI|25.0 %|&lt;img src=x onerror=alert(1)&gt;|75.0 %|LASI|100 %|" in text
    assert "|tool 2|0 %|–|tool 1|100 %|0.123 mm|tool 3|100 %|– mm|" in text


def test_rows_are_bounded(lab: Lab) -> None:
    labels = "".join(f"<Marker><Label>{'&lt;' * 200}{number}</Label></Marker>" for number in range(10_000))
    lab.send_parameters(f"<The_3D><Markers>10000</Markers>{labels}</The_3D>")
    lab.send_markers(*[number > 10 for number in range(10_000)])
    html = items_html(lab.source)
    assert html.count("<tr>") == MAX_ROWS + 1
    assert "9960 more markers, always visible" in html
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
    assert "0 markers</p>" in items_html(lab.source)


def test_events_the_newest_first(lab: Lab) -> None:
    lab.send_markers(True)
    assert "no events yet" in events_html(lab.source)
    now = time.time_ns() // 1000
    for number in range(30):
        lab.send(ComponentType.EVENT, [(number, 0, 7, -1, -1)], utime=now)
    html = events_html(lab.source)
    text = text_of(html)
    assert html.count("<tr>") == 21
    assert text.index("|event 29|param1: 7|") < text.index("|event 10|")
    assert "|event 9|" not in text


ANALOG = """<Analog><Channels>2</Channels><Channel><Label>EMG</Label><Unit>V</Unit></Channel>
<Channel><Label>Sync</Label></Channel></Analog>"""


def values(source: DisplayedSource, channel: PlotChannel) -> list[tuple[list[int], list[float]]]:
    found = samples(channel, source.components[channel.key].batch)
    return [(utimes.tolist(), values.tolist()) for utimes, values in found]


def test_channels_have_names_and_units(lab: Lab) -> None:
    lab.send(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)])
    lab.send(ComponentType.ANALOG, [1.0, 2.0])
    lab.send_parameters(ANALOG)
    found = choices([lab.source])
    assert [*found][:3] == ["lab analog 1: EMG (V)", "lab analog 2: Sync (mV)", "lab force 1: plate 1 Fx"]
    assert [*found.values()][2] == PlotChannel("lab", "force", 0, "fx")
    assert len(found) == 2 + 6


def test_choices_are_bounded(lab: Lab) -> None:
    lab.send(ComponentType.ANALOG, [0.0] * 10_000)
    found = choices([lab.source])
    assert len(found) == MAX_CHOICES
    assert max(map(len, found)) < 100


def test_samples_of_a_force_plate_and_while_the_number_of_channels_changes(lab: Lab) -> None:
    lab.send(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6), (7, 8, 9, 10, 11, 12)], utime=START_UTIME + 2000)
    for number in range(4):
        lab.send(ComponentType.ANALOG, [number] * (1 + number % 3), utime=START_UTIME + 2000 + number)
    source = lab.source
    assert values(source, PlotChannel("lab", "force", 1, "mx")) == [([START_UTIME], [10])]
    channel = PlotChannel("lab", "analog", 1, "")
    assert values(source, channel) == [([START_UTIME + 1], [1]), ([START_UTIME + 2], [2])]
