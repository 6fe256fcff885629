from collections import Counter
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest

from gateway.outputs.pacing import Pacer

EPOCH_UTIME = 1_700_000_000_000_000


def picked(
    pacer: Pacer, timestamps_us: Iterable[int | None], arrivals_utime: Iterable[int] = ()
) -> list[int]:
    """Return the indices of the frames that are due; without arrival times, all arrive at once."""
    stamps = list(timestamps_us)
    arrivals = list(arrivals_utime) or len(stamps) * [EPOCH_UTIME]
    return [
        index
        for index, (timestamp_us, arrival_utime) in enumerate(zip(stamps, arrivals, strict=True))
        if pacer.due(timestamp_us, arrival_utime)
    ]


def stamps(rate_hz: float, seconds: float, start_us: int = 0) -> list[int]:
    return [start_us + round(index * 1e6 / rate_hz) for index in range(round(seconds * rate_hz))]


def gaps(indices: list[int]) -> Counter[int]:
    return Counter(after - before for before, after in pairwise(indices))


def test_a_fractional_ratio_does_not_drift() -> None:
    indices = picked(Pacer(59.94), stamps(240, 1000))
    assert len(indices) == 59_940


@pytest.mark.parametrize("rate_hz", [99.99, 100.01])
def test_a_server_slightly_off_its_rate_gives_even_gaps(rate_hz: float) -> None:
    exact = stamps(rate_hz, 1000)
    jitter = np.random.default_rng(0).integers(-500, 500, len(exact))
    indices = picked(Pacer(50), (np.array(exact) + jitter).tolist())
    # It is off by five frames in 1000 s, so about five gaps have one or three frames, not fifty in turns.
    assert len(indices) == pytest.approx(50_000, abs=1)
    assert gaps(indices)[2] >= len(indices) - 1 - 10


def test_time_stamps_in_whole_milliseconds_give_even_gaps() -> None:
    coarse = [stamp // 1000 * 1000 for stamp in stamps(400, 10)]
    assert set(gaps(picked(Pacer(100), coarse))) == {4}
    assert len(picked(Pacer(400), coarse)) == 4000


def test_a_lost_frame_does_not_shift_the_others() -> None:
    whole = stamps(100, 1)
    lost = whole[:11] + whole[12:]
    sent = [lost[index] for index in picked(Pacer(50), lost)]
    assert sent == whole[::2]


@pytest.mark.parametrize("stamp", [0, 2**62, None])
def test_without_a_clock_the_arrival_times_decide(stamp: int | None) -> None:
    arrivals = [EPOCH_UTIME + stamp for stamp in stamps(100, 10)]
    indices = picked(Pacer(60), len(arrivals) * [stamp], arrivals)
    assert len(indices) == 600
    assert set(gaps(indices)) == {1, 2}


def test_a_step_of_the_host_clock_hardly_changes_the_count() -> None:
    arrivals = [EPOCH_UTIME + stamp - 3_600_000_000 * (stamp >= 5_000_000) for stamp in stamps(100, 10)]
    indices = picked(Pacer(50), len(arrivals) * [None], arrivals)
    assert len(indices) == pytest.approx(500, abs=1)


def test_the_gaps_follow_a_change_of_the_rate() -> None:
    frames = stamps(100, 5) + stamps(400, 5, start_us=5_000_000)
    indices = picked(Pacer(50), frames)
    assert set(gaps(indices[:250])) == {2}
    assert set(gaps(indices[260:])) == {8}


HZ_100 = stamps(100, 10)
EARLY_PAUSE = [0, *stamps(100, 1, start_us=60_003_000)]
PAUSE = stamps(100, 1) + stamps(100, 1, start_us=60_003_000)
DOUBLED = [stamp for stamp in stamps(100, 1) for _ in range(2)]


@pytest.mark.parametrize(
    ("rate_hz", "timestamps_us", "expected"),
    [
        # Multiples of 25 ms; at 25 and 75 ms two frames are equally near: the first is picked.
        pytest.param(40, HZ_100[:15], [0, 2, 5, 7, 10, 12], id="the frames nearest to the multiples"),
        pytest.param(10, PAUSE, range(0, 200, 10), id="a pause is not caught up with"),
        pytest.param(10, EARLY_PAUSE, [0, *range(1, 101, 10)], id="an early pause is not the spacing"),
        pytest.param(50, DOUBLED, range(0, 200, 4), id="a duplicate frame is picked once"),
        pytest.param(0.001, [0, 1_000, 2_000, 999_999_000, 1_000_000_000], [0, 4], id="1000 s to the ms"),
        # The period is 19 us; the frame at 12 us is 7 us early and the one at 16 us exactly 3 of 4 us.
        pytest.param(1e6 / 19, [0, 4, 8, 12, 16], [0, 4], id="early by three quarters of the spacing"),
        pytest.param(1000, [0, 2000, 2100, 2200], [0, 1], id="two periods start a whole one"),
        pytest.param(1000, [0, 1999, 2099], [0, 1, 2], id="just under two leave the next one on time"),
    ],
)
def test_the_frames_picked_by_time_stamps(
    rate_hz: float, timestamps_us: list[int], expected: Iterable[int]
) -> None:
    assert picked(Pacer(rate_hz), timestamps_us) == list(expected)


ARRIVALS = [EPOCH_UTIME + stamp for stamp in HZ_100]
LATE = ARRIVALS[:50] + 950 * [ARRIVALS[-1]]
LOOPED = [stamp % 1_690_000 for stamp in HZ_100]
KNOWN_AT_TIMES = [None if 200 <= index < 500 else stamp for index, stamp in enumerate(HZ_100)]


@pytest.mark.parametrize(
    ("timestamps_us", "arrivals"),
    [
        pytest.param(HZ_100, LATE, id="late arrivals"),
        pytest.param(LOOPED, ARRIVALS, id="time stamps that go back"),
        pytest.param(KNOWN_AT_TIMES, ARRIVALS, id="a clock that comes and goes"),
    ],
)
def test_the_gaps_stay_even(timestamps_us: list[int | None], arrivals: list[int]) -> None:
    assert picked(Pacer(50), timestamps_us, arrivals) == list(range(0, 1000, 2))


def test_no_time_passes_while_the_hosts_clock_stands_still_or_goes_back() -> None:
    arrivals = [EPOCH_UTIME, EPOCH_UTIME, EPOCH_UTIME - 10, EPOCH_UTIME - 10]
    assert picked(Pacer(1e6), [None] * 4, arrivals) == [0]
