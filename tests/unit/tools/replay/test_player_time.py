"""When a replay publishes what, by a clock that jumps: hours of replay without waiting."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.takes.files.reader import TakeReader
from gateway.tools.replay.pace import STALL_S, Pace, PlayerClock
from gateway.tools.replay.play_list import Selection
from gateway.tools.replay.player import Player
from gateway.tools.replay.timeline import Jump
from tests.support.takes import START_UTIME, description, markers, parameters, write_take

XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"
TICK_S = 0.01
"""The time between two frames."""


class JumpingClock(PlayerClock):
    """A clock that jumps to the end of each wait; ``on_pause`` is called when a wait has no end."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.on_pause: list[Callable[[], None]] = []

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, seconds: float) -> None:
        self.time_s += seconds

    def wait(self, changed: threading.Condition, seconds: float | None) -> None:  # noqa: ARG002
        if seconds is not None:
            self.time_s += seconds
        else:
            self.on_pause.pop(0)()


class Replay:
    """A replay of a take with a frame each 10 ms; ``steps`` are called when that frame is published."""

    def __init__(self, folder: Path, num_frames: int = 1000) -> None:
        self.clock = JumpingClock()
        self.steps: dict[int, Callable[[], None]] = {}
        self.jumps: list[Jump] = []
        self.published: list[tuple[int, float]] = []
        self.num_parameters = 0
        frames = [markers(1, number) for number in range(num_frames)]
        self.path = write_take(folder / "take.lcmlog", [description(), parameters(XML), *frames])
        self.player: Player

    def publish(self, _source: str, key: str, message: bytes) -> None:
        """Note a frame, and the time since the start in s."""
        if key == "parameters":
            self.num_parameters += 1
            return
        number = rtc3d.markers_t.decode(message).sequence
        self.published.append((number, round(self.clock.time_s - 100.0, 6)))
        self.steps.pop(len(self.published), lambda: None)()

    def prepare(self, selection: Selection | None = None, **options: Any) -> Player:
        """Make the player."""
        options |= {"on_jump": self.jumps.append, "clock": self.clock}
        self.player = Player(TakeReader(self.path), selection or Selection(), self, **options)
        return self.player

    @property
    def pace(self) -> Pace:
        """The player's pace; it has one unless ``rate`` is None."""
        assert self.player.pace is not None
        return self.player.pace

    def run(self) -> list[tuple[int, float]]:
        """Play until the end; return the frames with their times."""
        self.player.start()
        self.player.join(30)
        assert not self.player.is_alive
        assert self.player.error is None
        return self.published


@pytest.fixture
def replay(tmp_path: Path) -> Replay:
    return Replay(tmp_path)


@pytest.mark.parametrize(("rate", "begin"), [(1.0, 0), (0.25, 0), (100.0, 0), (1.0, 400)])
def test_each_message_is_published_when_it_is_due(replay: Replay, rate: float, begin: int) -> None:
    """No error adds up, at any rate and from any place."""
    replay.prepare(Selection(start_us=begin * 10_000), rate=rate)
    expected = [(number, round((number - begin) * TICK_S / rate, 6)) for number in range(begin, 1000)]
    found = replay.run()
    assert [number for number, _ in found] == [number for number, _ in expected]
    for (_, time_s), (_, due_s) in zip(found, expected, strict=True):
        assert time_s == pytest.approx(due_s, abs=1e-5)
    assert replay.pace.lateness.max_s < 1e-5
    assert replay.player.seconds == pytest.approx((999 - begin) * TICK_S / rate)


def test_a_pause_moves_all_that_follows_by_its_length(replay: Replay) -> None:
    """Without that, everything that was due meanwhile would come at once."""
    player = replay.prepare()

    def go_on() -> None:
        replay.clock.time_s += 3600.0
        player.control.pause(False)

    replay.steps[100] = lambda: player.control.pause(True)
    replay.clock.on_pause = [go_on]
    found = replay.run()
    assert found[99] == (99, 0.99)
    assert found[100][1] == pytest.approx(3601.0, abs=0.011)
    assert found[-1][1] - found[100][1] == pytest.approx(8.99)
    assert replay.pace.stalled_s == 0.0


@pytest.mark.parametrize(("stall_s", "is_made_up"), [(0.9 * STALL_S, True), (60.0, False)])
def test_only_what_a_short_stall_delays_is_made_up(replay: Replay, stall_s: float, is_made_up: bool) -> None:
    """After a suspended laptop wakes, minutes of frames at once would overrun every receiver."""

    def stall() -> None:
        replay.clock.time_s += stall_s

    replay.prepare()
    replay.steps[100] = stall
    found = replay.run()
    end_s = 9.99 if is_made_up else 9.99 + stall_s
    assert found[-1][1] == pytest.approx(end_s, abs=0.011)
    assert replay.pace.stalled_s == pytest.approx(0.0 if is_made_up else stall_s, abs=0.011)


def test_seeks_add_up_and_the_schedule_begins_there(replay: Replay) -> None:
    """Two presses of a key mean twice as far; what lies between is neither published nor waited for."""
    player = replay.prepare()

    def seek_twice() -> None:
        player.control.seek(2_000_000)
        player.control.seek(1_000_000)

    replay.steps[100] = seek_twice
    replay.steps[200] = lambda: player.control.seek(-100_000_000)
    replay.steps[300] = lambda: player.control.seek_to(9_990_000)
    found = replay.run()
    assert [number for number, _ in found[:100]] == [*range(100)]
    assert [number for number, _ in found[100:200]] == [*range(398, 498)]
    assert [number for number, _ in found[200:300]] == [*range(100)]
    assert [number for number, _ in found[300:]] == [999]
    assert found[100][1] == pytest.approx(0.99)
    assert found[199][1] == pytest.approx(0.99 * 2)
    assert replay.num_parameters == 4  # they come first, wherever it begins


def test_the_rate_changes_from_the_present_place_on(replay: Replay) -> None:
    """The part that was played is not played faster afterwards."""
    player = replay.prepare()
    replay.steps[100] = lambda: player.control.set_rate(10.0)
    replay.steps[200] = lambda: player.control.set_rate(0.1)
    found = replay.run()
    assert found[199][1] == pytest.approx(0.99 + 0.1)
    assert found[-1][1] == pytest.approx(0.99 + 0.1 + 80.0)


def test_only_a_paused_viewer_gets_a_preview(replay: Replay) -> None:
    """0.1 s at once shows the moment of a seek; while it plays, the pace holds."""
    player = replay.prepare(is_watched=True)
    replay.steps[50] = lambda: player.control.pause(True)
    replay.clock.on_pause = [
        lambda: player.control.seek_to(5_000_000),
        lambda: player.control.pause(False),
        player.control.stop,  # at the end
    ]
    found = replay.run()
    assert [number for number, _ in found] == [*range(50), *range(500, 1000)]
    assert [time_s for _, time_s in found[50:60]] == [0.49] * 10
    assert found[9][1] == pytest.approx(0.09)
    assert found[60][1] == pytest.approx(0.49)
    assert found[-1][1] == pytest.approx(0.49 + 4.89)


def test_a_viewer_can_go_back_from_the_end(replay: Replay) -> None:
    """It waits there, and says so, until there is something to do."""
    player = replay.prepare(is_watched=True)
    states: list[bool] = []

    def go_back() -> None:
        states.append(player.control.is_at_end)
        player.control.seek_to(9_950_000)

    replay.clock.on_pause = [go_back, player.control.stop]
    found = replay.run()
    assert [number for number, _ in found[1000:]] == [*range(995, 1000)]
    assert (states, player.control.is_at_end, player.num_passes) == ([True], False, 2)


def test_a_long_gap_is_skipped_and_reported_in_the_first_pass_only(tmp_path: Path) -> None:
    """The user has read it; a repeated take would fill the terminal."""
    replay = Replay(tmp_path, 0)
    hour_us = 3_600_000_000
    late = [markers(1, number, utime=START_UTIME + hour_us + number * 10_000) for number in range(10, 20)]
    write_take(replay.path, [*(markers(1, number) for number in range(10)), *late])
    player = replay.prepare(is_repeated=True)
    replay.steps[45] = player.control.stop
    found = replay.run()
    assert [(jump.jump_us, jump.is_skipped) for jump in replay.jumps] == [(hour_us + 10_000, True)]
    assert [number for number, _ in found] == [*range(20), *range(20), *range(5)]
    assert found[20][1] - found[19][1] == pytest.approx(0.01)  # the pause before each pass
