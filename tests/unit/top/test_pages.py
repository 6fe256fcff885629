import pytest

from gateway.live.live_data import LiveData, LiveSource
from gateway.top import facts, pages
from gateway.top.pages import PAGES, TWO_GATEWAYS, Page, event_time
from gateway.top.table import laid_out, sorted_by
from tests.statuses import count, loss, output, stream
from tests.unit.top.live_lab import LiveLab


def shown(page: str, *sources: LiveSource) -> list[str]:
    table = next(each for each in PAGES if each.name == page).table(sources)
    lines = laid_out(sorted_by(table, table.order), 200, table.order)
    return [" ".join("".join(text for text, _ in line).split()) for line in (lines.titles, *lines.body)]


def test_the_overview_has_a_line_per_source_and_one_per_component() -> None:
    live = LiveData()
    lab, stage = LiveLab(live, "lab"), LiveLab(live, "stage")
    lab.status(stream("3d event"))
    stage.status(stream("6d", "waiting to reconnect"))
    lab.frame("3d", 0, 2, missing=(1,))
    _, heading, markers, event, gap, other, *_ = shown("overview", *live.update())
    assert (heading, gap, other) == ("lab: streaming 200.0 Hz", "", "stage: waiting for 192.0.2.20:3020")
    assert markers.startswith("3d 0.0 0 0 0 2.0/2.0 ")
    assert " 2 1 0.0" in markers
    assert event == "event 0.0 0 0 0 none so far"


def test_the_overview_says_that_two_gateways_have_one_name() -> None:
    lab = LiveLab()
    for number in range(12):
        lab.frame("3d", number, 1)
        lab.frame("3d", 5000 + number, 1)
    assert TWO_GATEWAYS in shown("overview", lab.source())


def test_the_overview_says_what_is_wrong_with_an_output() -> None:
    lab = LiveLab()
    lab.status(stream("3d"), outputs=(output("zenoh"), output("lcm", connected=False, problem="no route")))
    assert shown("overview", lab.source())[1:3] == ["lab: streaming 200.0 Hz", "lab to lcm: no route"]


def test_markers_that_are_seen_least_come_first() -> None:
    lab = LiveLab()
    lab.labels("LASI", "RASI", "SACR")
    for number in range(1000):
        lab.frame("3d", number, 3, missing=(1,) if number < 500 else (2,) if number == 500 else ())
    assert shown("markers", lab.source())[1:] == [
        "RASI 50.0 % visible 1.0 1.0 1.0 mm lab",
        "SACR 99.9 % visible 1.0 1.0 1.0 mm lab",
        "LASI 100.0 % visible 1.0 1.0 1.0 mm lab",
    ]


def test_a_missing_marker_has_no_position() -> None:
    lab = LiveLab()
    lab.frame("3d", 0, 1, missing=(0,))
    assert shown("markers", lab.source())[1:] == ["marker 1 0.0 % missing mm lab"]


def test_tools_have_an_error() -> None:
    lab = LiveLab()
    lab.frame("6d", 0, 1)
    assert shown("tools", lab.source())[1:] == ["tool 1 100.0 % visible 1.000 1.0 1.0 1.0 mm lab"]


def test_the_server_has_its_streams_their_clock_and_what_is_wrong() -> None:
    lab = LiveLab()
    ticking = stream("3d", session=3, byte_order="big", rate="AllFrames", lag_ms=1.5, reconnects=2)
    ticking.clock.has_clock, ticking.clock.drift_ppm, ticking.clock.uncertainty_us = True, 12.5, 40.0
    lab.status(ticking, stream("6d", limitations=["no SendParameters"], last_error="refused"))
    assert shown("server", lab.source())[1:] == [
        "lab from 192.0.2.20:3020 by gw1 (version 1.2.3)",
        "3d streaming 200.0 3 2 0 big AllFrames 1.5 12.50 40.0",
        "6d streaming 200.0 0 0 0 0.0",
        "6d: no SendParameters",
        f"6d: last error, {event_time(0)}: refused",
        "6d: its time stamps are no clock",
    ]


def test_drops_outputs_and_questions() -> None:
    lab = LiveLab()
    lab.status(
        stream("3d", drops=[loss("skipped while behind", 8, 4)]),
        outputs=(
            output("zenoh", messages=[count("3d", 5), count("6d", 6)], queries=[count("ok", 3)]),
            output("lcm", connected=False, problem="no route"),
        ),
    )
    source = lab.source()
    assert shown("drops", source)[1:] == ["lab stream 3d skipped while behind 8 4"]
    assert shown("outputs", source)[1:] == [
        "lab zenoh connected 11 3d 5, 6d 6",
        "lab lcm not connected 0",
        "lab to lcm: no route",
    ]
    assert shown("questions", source)[1:] == ["lab zenoh ok 3"]


def test_events_have_a_time_and_the_newest_one_comes_first() -> None:
    lab = LiveLab()
    lab.frame("event", 0, 1)
    lab.frame("event", 1, 1)
    source = lab.source()
    times = [event_time(event.capture_utime) for event in source.events]
    assert shown("events", source)[1:] == [
        f"{times[1]} event 1 param1: 1; param2: 1; param3: 1 lab",
        f"{times[0]} event 1 param1: 1; param2: 1; param3: 1 lab",
    ]


@pytest.mark.parametrize("utime", [-(1 << 63), (1 << 63) - 1])
def test_a_time_that_no_calendar_has(utime: int) -> None:
    assert event_time(utime) == "?"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_page_says_that_there_is_nothing(page: Page) -> None:
    assert laid_out(page.table([]), 80).body


@pytest.mark.parametrize("width", [1, 40, 200])
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_hostile_texts_keep_every_line_printable(page: Page, width: int) -> None:
    lab = LiveLab(name="lab")
    hostile = "\x1b]0;title\x07\u202e\u0301" + "漢" * 3000
    lab.labels("\u202eRASI", "漢" * 400, "e\u0301" * 100)
    lab.frame("3d", 0, 3)
    lab.frame("6d", 0, 3, missing=(0,))
    lab.frame("event", 0, 1)
    lab.status(
        stream(hostile, hostile, limitations=[hostile], last_error=hostile, frame_rate_hz=float("inf")),
        outputs=(output(hostile, problem=hostile, queries=[count(hostile, -5)]),),
        server=hostile,
    )
    lines = laid_out(page.table([lab.source()]), width)
    for line in (lines.titles, *lines.body):
        assert all(text.isprintable() for text, _ in line)


def test_thousands_of_markers_are_one_table() -> None:
    lab = LiveLab()
    lab.frame("3d", 0, 5000, missing=tuple(range(0, 5000, 7)))
    source = lab.source()
    assert len(facts.markers(source)) == 5000
    lines = laid_out(sorted_by(pages.markers([source]), pages.markers([source]).order), 80)
    assert len(lines.body) == 5000
