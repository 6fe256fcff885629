"""Which frames are passed on at once, and when reading from the server is paused."""

from gateway.rtc3d.frames import Frame
from gateway.stream.backlog import Backlog
from gateway.stream.clock import ServerClock
from gateway.stream.paced_frames import MAX_TOGETHER, PacedFrames
from gateway.stream.running_clock import running_clock
from tests.unit.stream.test_backlog import frames
from tests.virtual_time import read_clocks, stop_process, until


class Lab:
    """Paced frames, and what they call. ``numbers`` are those of the frames that were passed on."""

    def __init__(self, *, has_pace: bool = True, frame_s: float = 0.0) -> None:
        self.frame_s = frame_s
        """How long it takes to pass on a frame."""
        clock = ServerClock()
        clock.has_clock = has_pace
        backlog = Backlog(self._on_frames, clock, 2.0, read_clocks)
        self.numbers: list[int] = []
        self.reading: list[bool] = []
        self.defects: list[Exception] = []
        self.defect: Exception | None = None
        """What passing frames on raises."""
        self.paced = PacedFrames(backlog, self.reading.append, self.defects.append)

    def _on_frames(self, passed: list[Frame], _utime: int, _steady_us: int) -> None:
        if self.defect is not None:
            raise self.defect
        self.numbers += [each.number_and_timestamp[0] for each in passed]
        stop_process(self.frame_s * len(passed))
        stop_process(self.frame_s * len(passed))

    def receive(self, count: int, first: int = 0) -> None:
        self.paced.receive(frames(count, first), *read_clocks())


async def test_a_few_frames_together_are_passed_on_at_once() -> None:
    lab = Lab()
    lab.receive(MAX_TOGETHER)
    assert lab.numbers == list(range(MAX_TOGETHER))
    assert lab.reading == []
    assert lab.paced.caught_up_s == 0.0


async def test_a_few_frames_that_take_long_are_passed_on_one_by_one() -> None:
    """So that other sources have their turn in between."""
    lab = Lab(has_pace=False, frame_s=0.007)
    lab.receive(1)
    lab.receive(2, first=1)
    assert (lab.numbers, lab.reading) == ([0, 1], [False])
    await until(lambda: lab.reading[-1])
    assert lab.numbers == [0, 1, 2]


async def test_reading_is_paused_until_a_backlog_is_passed_on() -> None:
    lab = Lab()
    lab.receive(1000)
    assert 0 < len(lab.numbers) < 1000
    assert lab.reading == [False]
    await until(lambda: lab.reading[-1])
    assert lab.numbers == list(range(1000))
    assert running_clock().time() - lab.paced.caught_up_s < 0.02


async def test_frames_that_arrive_during_a_backlog_wait_behind_it() -> None:
    lab = Lab()
    lab.receive(1000)
    lab.receive(1, first=1000)
    await until(lambda: lab.reading[-1])
    assert lab.numbers == list(range(1001))


async def test_without_a_pace_frames_wait_only_for_their_turn() -> None:
    lab = Lab(has_pace=False)
    lab.receive(1000)
    assert lab.numbers == list(range(1000))
    assert lab.reading == [True]
    assert lab.paced.is_empty


async def test_finishing_passes_on_everything_and_what_follows_at_once() -> None:
    lab = Lab()
    lab.receive(1000)
    lab.paced.finish()
    assert lab.numbers == list(range(1000))
    lab.receive(1000, first=1000)
    assert lab.numbers == list(range(2000))
