"""The top of the panel: is the picture live?"""

import time

import pytest

from gateway.live.live_data import LiveSource
from gateway.view.banner import MAX_SOURCES, banner_html
from gateway.view.texts import clock_text
from tests.statuses import stream
from tests.unit.view.live_lab import Lab
from tests.unit.view.test_source_text import text_of
from tests.unit.view.test_state_text import wait

NOW_S = 1_700_000_000.5


def test_no_source() -> None:
    assert "No source is heard yet." in banner_html([], NOW_S)


def test_live_data_and_their_time() -> None:
    lab = Lab()
    lab.send_markers(True)
    text = text_of(banner_html([lab.source], NOW_S))
    assert f"● live|lab|last data {clock_text(NOW_S)}|" in text


def test_data_that_have_stopped_and_why(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    lab.send_markers(True)
    assert lab.source
    wait(monkeypatch, 3)
    lab.send_status(stream(state="no measurement"))
    html = banner_html([lab.source], NOW_S)
    assert "class=stopped" in html
    assert (
        f"|lab: no data for 3.0 s|. The picture is old.|last data {clock_text(NOW_S - 3)} · "
        "connected to 192.0.2.9:3020, no measurement running|"
    ) in text_of(html)


def test_the_text_differs_every_second() -> None:
    assert banner_html([], NOW_S) == banner_html([], NOW_S + 0.1)
    assert banner_html([], NOW_S) != banner_html([], NOW_S + 1)


def test_a_take_that_is_paused_is_not_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    lab.send_markers(True)
    source = lab.source
    assert "● recorded|lab" in text_of(banner_html([source], NOW_S, is_take=True))
    wait(monkeypatch, 3)
    assert "● no data for 3.0 s|lab" in text_of(banner_html([source], NOW_S, is_take=True))
    assert "● paused|lab" in text_of(banner_html([source], NOW_S, is_take=True, is_paused=True))


def test_many_sources_with_hostile_names() -> None:
    sources = [LiveSource("<img src=x>" + "y" * 1000, "MOCAP_X") for _ in range(64)]
    html = banner_html(sources, time.time())
    assert "<img" not in html
    assert html.count("&lt;img") == MAX_SOURCES
    assert "and 48 more sources" in html
    assert len(html) < 10_000
