"""The panel of a real viser server, without a browser."""

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser

from gateway.messages.host_time import now_utime
from gateway.messages.source_report import Level, State
from gateway.rtc3d.components import ComponentType
from gateway.takes.files.component_rows import decode_rows
from gateway.tools.display.live import DisplayedSource
from gateway.tools.display.view import panel as view_panel
from gateway.tools.display.view.panel import Panel
from gateway.tools.display.view.plots import MAX_PLOTS, RecentRows
from gateway.tools.display.view.texts import title_text
from tests.support.statuses import stream
from tests.support.takes import frame
from tests.unit.tools.display.live_lab import Lab, wait

Show = Callable[[], None]


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


@pytest.fixture(autouse=True)
def _is_watched(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "get_clients", lambda: {1: None})


@pytest.fixture
def panel(server: viser.ViserServer, lab: Lab) -> Panel:
    return Panel(server, server.gui.add_tab_group(), lab.live)


@pytest.fixture
def show(panel: Panel, lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Show:
    """Return a function that shows everything that is due within a second."""

    def show() -> None:
        wait(monkeypatch, 1)
        panel.update(lab.live.update())

    return show


def test_nothing_is_built_while_nobody_looks(
    panel: Panel, lab: Lab, show: Show, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "get_clients", dict)
    lab.send_markers(True)
    show()
    assert panel._banner.content == panel._sources.content == panel._items.content == ""


def test_all_tabs_are_filled(panel: Panel, lab: Lab, show: Show) -> None:
    lab.send_markers(True)
    lab.send(ComponentType.EVENT, [(7, 0, 1, 2, 3)])
    show()
    assert "live" in panel._banner.content
    assert "captured → gateway" in panel._sources.content
    assert "1 marker" in panel._items.content
    assert "event 7" in panel._events.content


def test_a_stop_is_said_at_once_and_texts_change_rarely(
    panel: Panel, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = {"banner_html": 0, "source_html": 0, "items_html": 0, "events_html": 0}
    for name in built:

        def count(*_arguments: object, name: str = name, **_options: object) -> str:
            built[name] += 1
            return ""

        monkeypatch.setattr(view_panel, name, count)
    begin_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: begin_s)
    lab.send_markers(True)
    panel.update(lab.live.update())
    for picture in range(60):
        now_s = begin_s + picture / 30
        monkeypatch.setattr(time, "monotonic", lambda now_s=now_s: now_s)
        lab.send_markers(True)
        panel.update(lab.live.update())
    assert built["banner_html"] <= 9
    assert max(built["source_html"], built["items_html"], built["events_html"]) <= 5
    panel.update(lab.live.update())
    before = built["banner_html"]
    wait(monkeypatch, 0.6)
    panel._turns.clear()  # nothing else is due
    panel.update(lab.live.update())
    assert built["banner_html"] == before + 1


def test_a_spike_is_in_the_plot_of_its_channel(panel: Panel, lab: Lab, show: Show) -> None:
    lab.send(ComponentType.ANALOG, [0.0, 1.0])
    show()
    plots = panel._plots
    assert "lab analog 2: channel 2 (mV)" in plots._add.options
    plots._add.value = "lab analog 2: channel 2 (mV)"  # type: ignore[misc]
    show()
    assert plots._add.value not in plots._plots
    for value in (0, 0, 99, 0, -50, 0):
        lab.send(ComponentType.ANALOG, [0.0, value])
    show()
    _, lowest, highest = plots._plots["lab analog 2: channel 2 (mV)"].handle.data
    assert np.nanmin(lowest) == -50
    assert np.nanmax(highest) == 99


def test_a_plot_that_is_added_shows_the_last_10_s_at_once(panel: Panel, lab: Lab, show: Show) -> None:
    """Whoever opens a plot has just seen something happen."""
    end_utime = now_utime()
    for age_s in range(15, -1, -1):
        lab.send(ComponentType.ANALOG, [0.0, age_s], utime=end_utime - age_s * 500_000)
        show()
    title = "lab analog 2: channel 2 (mV)"
    panel._plots._add.value = title  # type: ignore[misc]
    show()
    times_s, lowest, _ = panel._plots._plots[title].handle.data
    assert lowest[np.isfinite(lowest)].tolist() == [*range(15, -1, -1)]
    assert times_s[-1] - times_s[0] == pytest.approx(7.5, abs=0.1)


def test_what_is_kept_for_plots_is_bounded_by_time_and_bytes() -> None:
    messages = [
        frame(ComponentType.ANALOG, [1.0], number, utime=number * 1_000_000)[1] for number in range(30)
    ]
    batches = [decode_rows(ComponentType.ANALOG, [message]) for message in messages]
    recent = RecentRows()
    for batch in batches:
        recent.take(batch, 10**9)
    assert [each.heads["sequence"][0] for each in recent.batches] == [*range(19, 30)]
    recent.take(batches[-1], 3 * len(messages[0]))
    assert len(recent.batches) == 3


def test_a_first_plot_is_chosen_when_the_channels_are_known_and_stays_removed(
    panel: Panel, lab: Lab, show: Show
) -> None:
    plots = panel._plots
    lab.send(ComponentType.ANALOG, [0.0, 1.0])
    show()
    lab.send(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)])
    show()
    assert not plots._plots  # other channels came
    show()
    assert [*plots._plots] == ["lab force 1: plate 1 Fz"]
    plots._remove.value = "lab force 1: plate 1 Fz"  # type: ignore[misc]
    for _ in range(3):
        show()
    assert not plots._plots


def test_plots_are_limited_renamed_and_removed(panel: Panel, lab: Lab, show: Show) -> None:
    lab.send(ComponentType.ANALOG, range(20))
    show()
    plots = panel._plots
    offered = plots._add.options[1:]
    for text in offered[: MAX_PLOTS + 1]:
        plots._add.value = text  # type: ignore[misc]
        show()
    assert tuple(plots._plots) == offered[:MAX_PLOTS]
    lab.send_parameters("<Analog><Channels>1</Channels><Channel><Label>EMG</Label></Channel></Analog>")
    show()
    assert plots._plots["lab analog 1: EMG (mV)"].handle.title == "lab analog 1: EMG (mV)"
    plots._remove.value = "lab analog 1: EMG (mV)"  # type: ignore[misc]
    show()
    assert tuple(plots._plots) == offered[1:MAX_PLOTS]
    assert not set(plots._add.options) & set(plots._plots)
    plots._remove.value = "all"  # type: ignore[misc]
    show()
    assert not plots._plots
    assert not plots._remove.visible


def test_a_plot_scrolls_on_when_data_have_stopped(
    panel: Panel, lab: Lab, show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.send(ComponentType.ANALOG, [5.0])
    show()
    show()
    assert [*panel._plots._plots] == ["lab analog 1: channel 1 (mV)"]  # the first one, without a force
    for _ in range(100):
        lab.send(ComponentType.ANALOG, [5.0])
    panel.update(lab.live.update())
    wait(monkeypatch, 4)
    panel.update(lab.live.update())
    [plot] = panel._plots._plots.values()
    times_s, lowest, _ = plot.handle.data
    assert times_s[-1] - times_s[np.isfinite(lowest)] == pytest.approx(4, abs=0.2)


def test_the_notice_and_the_title_say_which_data_have_stopped_and_why(
    panel: Panel, lab: Lab, show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are seen while the panel is closed, and must not change each second."""
    lab.send_markers(True)
    lab.send(ComponentType.ANALOG, [1.0])
    lab.send_status(stream(state="waiting", frame_rate_hz=0.0))
    panel.update(lab.live.update())
    assert panel._notice.text == ""
    assert panel._title == "rtc3d-gateway · lab live"
    for _ in range(3):
        show()
    lab.send(ComponentType.ANALOG, [1.0])
    show()
    assert "lab: no 3d since " in panel._notice.text
    assert panel._title == "rtc3d-gateway · lab no 3d"
    wait(monkeypatch, 60)
    show()
    assert "lab: no data since " in panel._notice.text
    assert not panel._notice.visible


def test_a_title_names_the_worst_of_several_sources() -> None:
    gym, lab = Lab("gym"), Lab("lab")
    states = [State(Level.GOOD, "live"), State(Level.WAITING, "no data yet")]
    assert (
        title_text([source_of(gym), source_of(lab)], states)
        == "rtc3d-gateway · lab no data yet (of 2 sources)"
    )
    assert title_text([], []) == "rtc3d-gateway · no source yet"


def source_of(lab: Lab) -> DisplayedSource:
    lab.send_markers(True)
    return lab.source
