"""The panel of ``view`` in a real browser."""

import html
import itertools
import threading
from collections.abc import Iterator
from typing import Any, Final

import pytest
from playwright.sync_api import Page, expect

from gateway.rtc3d.components import ComponentType
from gateway.tools.display.view.panel import Panel
from gateway.tools.display.view.viewer import PERIOD_S, ViewServer
from tests.support.browser import NewPage, chromium, new_page
from tests.support.statuses import stream
from tests.unit.tools.display.live_lab import Lab
from tests.unit.tools.display.view.conftest import server

pytestmark = pytest.mark.chromium

__all__ = ["chromium", "new_page", "server"]

HOSTILE: Final = ("<img src=x onerror=alert(1)>", "[x](http://192.0.2.1)")
SPIKE: Final = 500.0

TIMEOUT_MS: Final = 180_000
"""Chromium that renders in software takes a while on a busy computer."""

_PLOTS: Final = "Object.values(window.__viserTestpoints?.uplots ?? {}).map(plot => plot.chart)"


class Shown:
    """A panel without a scene, in a thread, and a source that sends 50 frames a second in another one."""

    def __init__(self, server: ViewServer) -> None:
        self.lab = Lab()
        self.address = f"http://127.0.0.1:{server.get_port()}"
        self.value = 1.0
        """Of the second analog channel."""
        self._panel = Panel(server, server.gui.add_tab_group(), self.lab.live)
        self._ends = [threading.Event(), threading.Event()]
        self._threads = [
            threading.Thread(target=self._show),
            threading.Thread(target=self._send),
        ]
        labels = "".join(f"<Marker><Label>{html.escape(label)}</Label></Marker>" for label in HOSTILE)
        channel = f"<Channel><Label>{html.escape(HOSTILE[0])}</Label></Channel>"
        self.lab.send_parameters(
            f"<The_3D><Markers>2</Markers>{labels}</The_3D><Analog><Channels>1</Channels>{channel}</Analog>"
        )
        for thread in self._threads:
            thread.start()

    def stop_panel(self) -> None:
        """Show nothing new any more."""
        self._ends[0].set()
        self._threads[0].join()

    def stop(self) -> None:
        """End both threads."""
        self._ends[1].set()
        self._threads[1].join()
        self.stop_panel()

    def _show(self) -> None:
        while not self._ends[0].wait(PERIOD_S):
            self._panel.update(self.lab.live.update())

    def _send(self) -> None:
        for number in itertools.count():
            if self._ends[1].wait(0.02):
                return
            if number % 50 == 0:
                self.lab.send_status(stream())
            self.lab.send_markers(True, number % 2 == 0)
            self.lab.send(ComponentType.ANALOG, [0.5, self.value])


@pytest.fixture
def shown(server: ViewServer) -> Iterator[Shown]:
    shown = Shown(server)
    yield shown
    shown.stop()


@pytest.fixture
def page(shown: Shown, new_page: NewPage) -> Page:
    return open_page(shown, new_page, viewport={"width": 800, "height": 400})


def open_page(shown: Shown, new_page: NewPage, **options: Any) -> Page:
    """Open the panel in a page with these options."""
    page = new_page(**options)
    page.set_default_timeout(TIMEOUT_MS)
    page.goto(shown.address)
    return page


def choose(page: Page, channel: str) -> None:
    """Plot a channel besides the first one, which is chosen once the channels are known."""
    page.get_by_text("Plots", exact=True).click()
    expect(page.locator(".u-title").first).to_be_visible(timeout=TIMEOUT_MS)
    field = page.get_by_label("Plot", exact=True)
    field.click()
    field.fill(channel)
    page.get_by_role("option", name=channel).click()


def test_labels_are_text_wherever_they_are_shown(page: Page) -> None:
    page.get_by_text("Markers", exact=True).click()
    for label in HOSTILE:
        expect(page.get_by_text(label, exact=True)).to_be_visible(timeout=TIMEOUT_MS)
    page.get_by_text("Plots", exact=True).click()
    first_plot = page.locator(".u-title").first
    expect(first_plot).to_have_text(f"lab analog 1: {HOSTILE[0]} (mV)", timeout=TIMEOUT_MS)
    assert not page.locator("img[src=x], a[href*='192.0.2.1']").count()


def test_the_page_says_that_it_gets_nothing_any_more(page: Page, shown: Shown) -> None:
    line = page.get_by_text("This page gets nothing any more")
    expect(page.locator(".gateway").first).to_contain_text("● live lab", timeout=TIMEOUT_MS)
    expect(line).to_have_count(0, timeout=TIMEOUT_MS)
    shown.stop_panel()
    expect(line).to_be_visible(timeout=TIMEOUT_MS)


def test_in_a_narrow_window_the_panel_is_closed(shown: Shown, new_page: NewPage) -> None:
    page = open_page(shown, new_page, viewport={"width": 700, "height": 500})
    page.wait_for_function("document.querySelector('canvas')?.clientWidth > 600")
    expect(page.get_by_role("tab", name="Sources")).to_have_count(0, timeout=TIMEOUT_MS)
    page.wait_for_function("document.querySelector('canvas')?.clientWidth > 600")


def test_on_a_phone_the_panel_is_closed_until_somebody_taps_its_title(
    shown: Shown, new_page: NewPage
) -> None:
    page = open_page(shown, new_page, viewport={"width": 390, "height": 844}, has_touch=True)
    page.wait_for_function("document.querySelector('.gateway')?.getClientRects().length === 0")
    title = page.get_by_text("rtc3d-gateway · lab live")
    expect(title).to_be_visible(timeout=TIMEOUT_MS)
    box = title.bounding_box()
    assert box is not None
    assert box["height"] < 40  # one line
    title.tap()
    expect(page.get_by_role("tab", name="Sources")).to_be_visible(timeout=TIMEOUT_MS)
    assert page.evaluate("document.querySelector('.gateway').clientWidth") == 390


def test_a_spike_is_within_its_plot(page: Page, shown: Shown) -> None:
    choose(page, "lab analog 2: channel 2 (mV)")
    page.wait_for_function(f"{_PLOTS}.some(plot => plot.scales.y.max > 1)")
    shown.value = SPIKE
    page.wait_for_function(f"{_PLOTS}.some(plot => plot.scales.y.max >= {SPIKE})")
    shown.value = 1.0
    page.wait_for_function(f"{_PLOTS}.some(plot => plot.scales.y.max < {SPIKE})")
