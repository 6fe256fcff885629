"""Playing a take, and labels, in a real viser server; actions come as viser reports them."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from gateway.errors import TakeError
from gateway.tools.display.live import LiveData
from gateway.tools.display.view.scene_items import Labels
from gateway.tools.display.view.viewer import Playback, Viewer
from tests.support.takes import description, markers, parameters, write_take
from tests.support.waiting import wait_until

XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"
USER = SimpleNamespace(client_id=1)


class Played:
    def __init__(self, folder: Path, gui: viser.GuiApi) -> None:
        messages = [description(), parameters(XML), *(markers(1, number) for number in range(3000))]
        self.live = LiveData()
        self.playback = Playback(write_take(folder / "walk.lcmlog", messages), (), self.live)
        self.playback.add_controls(gui)
        self.playback.follow([1])

    @property
    def newest(self) -> int:
        """The sequence number of the newest frame."""
        for source in self.live.update():
            if "3d" in source.components and source.components["3d"].newest_head is not None:
                return int(source.components["3d"].newest_head["sequence"])
        return -1

    def drag_to(self, position_s: float) -> None:
        self.playback._slider.value = position_s  # type: ignore[misc]
        self.playback._seek(USER)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def played(tmp_path: Path, server: viser.ViserServer) -> Iterator[Played]:
    played = Played(tmp_path, server.gui)
    yield played
    played.playback.close()


def test_the_take_plays_and_the_slider_follows(played: Played) -> None:
    wait_until(lambda: played.newest > 10)

    def is_followed() -> bool:
        played.playback.update()
        return played.playback._slider.value > 0.1

    wait_until(is_followed)
    assert "of 0:00:29.9, playing" in played.playback._state.content


def test_a_take_begins_when_the_first_page_is_open(
    tmp_path: Path, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short take would be over before anybody sees it."""
    pages: dict[int, object] = {}
    monkeypatch.setattr(server, "get_clients", lambda: pages)
    live = LiveData()
    path = write_take(tmp_path / "walk.lcmlog", [description(), parameters(XML), markers(1, 0)])
    playback = Playback(path, (), live)
    viewer = Viewer(server, live, playback)
    viewer.update()
    assert not playback._player.is_alive
    playback.close()
    monkeypatch.setattr(viewer.scene, "update", lambda *_: None)
    pages[1] = None
    viewer.update()
    wait_until(lambda: playback._player.control.is_at_end)
    viewer.update()
    playback.close()


def test_a_page_that_opens_later_sees_the_same_moment_as_the_others(played: Played) -> None:
    played.drag_to(20.0)
    wait_until(lambda: played.newest > 2000)
    played.playback.follow([1, 2])
    played.playback.follow([2])
    newest = played.newest
    wait_until(lambda: played.newest > newest + 10)


def test_a_page_that_opens_alone_or_at_the_end_sees_the_take_from_the_start(played: Played) -> None:
    """A take that plays while nobody looks would be over, and costs as much as one that somebody sees."""
    control = played.playback._player.control
    played.drag_to(20.0)
    wait_until(lambda: played.newest > 2000)
    played.playback.follow([])
    assert played.playback.is_paused
    played.playback.follow([2])
    wait_until(lambda: 0 <= played.newest < 2000)
    assert not control.is_paused
    played.drag_to(29.8)
    wait_until(lambda: control.is_at_end)
    played.playback.follow([2])
    assert control.is_at_end
    played.playback.follow([2, 3])
    wait_until(lambda: 0 <= played.newest < 2000)


def test_a_pause_stands_still_and_shows_where_the_slider_goes(played: Played) -> None:
    wait_until(lambda: played.newest >= 0)
    played.playback._toggle(USER)
    assert played.playback.is_paused
    played.drag_to(20.0)
    wait_until(lambda: played.newest == 2009)
    played.drag_to(1.0)
    wait_until(lambda: played.newest == 109)
    played.playback._toggle(USER)
    wait_until(lambda: played.newest > 110)


def test_the_end_waits_for_play(played: Played) -> None:
    played.drag_to(29.8)
    wait_until(lambda: played.playback._player.control.is_at_end)
    assert played.playback.is_paused
    played.playback._toggle(USER)
    wait_until(lambda: 0 <= played.newest < 2000)


def test_the_speed_can_be_chosen(played: Played) -> None:
    played.playback._rate.value = "10 ×"  # type: ignore[misc]
    wait_until(lambda: played.playback._player.control.is_at_end)
    assert played.newest == 2999


def test_a_take_with_a_damaged_end_has_a_length(tmp_path: Path) -> None:
    path = write_take(
        tmp_path / "walk.lcmlog", [description(), *(markers(1, number) for number in range(100))]
    )
    with path.open("ab") as file:
        file.write(bytes(5 * 1024 * 1024))
    assert Playback(path, (), LiveData())._length_us == 990_000


def test_no_take_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(TakeError):
        Playback(tmp_path / "missing.lcmlog", (), LiveData())
    path = write_take(tmp_path / "empty.lcmlog", [description()])
    with pytest.raises(TakeError, match="has no messages"):
        Playback(path, (), LiveData())


def test_labels_from_the_network_are_one_line_of_limited_length() -> None:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        labels = Labels(server.scene, "/labels")
        positions = np.zeros((2, 3), np.float32)
        labels.update(positions, ["", ""], now_s=0.0)
        labels.update(positions, ["a\n\u202eb", "L" * 500], now_s=1.0)
        assert [node.text for node in labels._nodes] == [r"a\n\u202eb", "L" * 99 + "…"]
        more = np.zeros((3, 3), np.float32)
        labels.update(more, ["a", "b", "c\td"], now_s=2.0)
        assert [node.text for node in labels._nodes] == ["a", "b", r"c\td"]
    finally:
        server.stop()
