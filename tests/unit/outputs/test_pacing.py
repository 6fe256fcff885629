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


def test_60_of_100_hz_is_exact_with_gaps_of_one_and_two() -> None:
    indices = picked(Pacer(60), stamps(100, 10))
    assert len(indices) == 600
    assert set(gaps(indices)) == {1, 2}


def test_the_frames_nearest_to_the_multiples_are_picked() -> None:
    # Multiples of 25 ms among frames 10 ms apart; at 25 and 75 ms two are equally near: the first is picked.
    assert picked(Pacer(40), stamps(100, 0.15)) == [0, 2, 5, 7, 10, 12]


@pytest.mark.parametrize("max_rate_hz", [100, 100.5, 1000])
def test_a_limit_above_the_rate_picks_all_frames(max_rate_hz: float) -> None:
    assert len(picked(Pacer(max_rate_hz), stamps(100, 10))) == 1000


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


def test_a_pause_is_not_caught_up_with() -> None:
    frames = stamps(100, 1) + stamps(100, 1, start_us=60_003_000)
    assert picked(Pacer(10), frames) == list(range(0, 200, 10))


def test_a_pause_after_the_first_frame_is_not_taken_for_the_spacing() -> None:
    frames = [0, *stamps(100, 1, start_us=60_003_000)]
    assert picked(Pacer(10), frames) == [0, *range(1, 101, 10)]


def test_frames_that_arrive_late_are_picked_by_their_time_stamps() -> None:
    frames = stamps(100, 2)
    arrivals = [EPOCH_UTIME + stamp for stamp in frames[:50]] + 150 * [EPOCH_UTIME + 2_000_000]
    assert picked(Pacer(50), frames, arrivals) == list(range(0, 200, 2))


def test_time_stamps_that_go_back_do_not_change_the_gaps() -> None:
    arrivals = [EPOCH_UTIME + stamp for stamp in stamps(100, 10)]
    looped = [stamp % 1_690_000 for stamp in stamps(100, 10)]
    assert picked(Pacer(50), looped, arrivals) == list(range(0, 1000, 2))


@pytest.mark.parametrize("stamp", [0, 2**62, None])
def test_without_a_clock_the_arrival_times_decide(stamp: int | None) -> None:
    arrivals = [EPOCH_UTIME + stamp for stamp in stamps(100, 10)]
    indices = picked(Pacer(60), len(arrivals) * [stamp], arrivals)
    assert len(indices) == 600
    assert set(gaps(indices)) == {1, 2}


def test_a_clock_that_comes_and_goes_does_not_change_the_gaps() -> None:
    arrivals = [EPOCH_UTIME + stamp for stamp in stamps(100, 10)]
    known = [None if 200 <= index < 500 else stamp for index, stamp in enumerate(stamps(100, 10))]
    assert picked(Pacer(50), known, arrivals) == list(range(0, 1000, 2))


def test_a_step_of_the_host_clock_hardly_changes_the_count() -> None:
    arrivals = [EPOCH_UTIME + stamp - 3_600_000_000 * (stamp >= 5_000_000) for stamp in stamps(100, 10)]
    indices = picked(Pacer(50), len(arrivals) * [None], arrivals)
    assert len(indices) == pytest.approx(500, abs=1)


def test_a_duplicate_frame_is_picked_once() -> None:
    doubled = [stamp for stamp in stamps(100, 1) for _ in range(2)]
    assert picked(Pacer(50), doubled) == list(range(0, 200, 4))


def test_the_gaps_follow_a_change_of_the_rate() -> None:
    frames = stamps(100, 5) + stamps(400, 5, start_us=5_000_000)
    indices = picked(Pacer(50), frames)
    assert set(gaps(indices[:250])) == {2}
    assert set(gaps(indices[260:])) == {8}


def test_one_frame_in_1000_seconds_goes_out_when_they_have_passed_to_the_millisecond() -> None:
    timestamps_us = [0, 1_000, 2_000, 999_999_000, 1_000_000_000]
    assert picked(Pacer(0.001), timestamps_us) == [0, 4]


def test_a_frame_may_be_early_by_three_quarters_of_the_spacing() -> None:
    # The period is 19 us; the frame at 12 us is 7 us early and the one at 16 us exactly 3 of 4 us.
    assert picked(Pacer(1e6 / 19), [0, 4, 8, 12, 16]) == [0, 4]


def test_a_frame_that_ends_a_pause_of_two_periods_starts_a_whole_period() -> None:
    assert picked(Pacer(1000), [0, 2000, 2100, 2200]) == [0, 1]


def test_a_frame_just_before_the_end_of_the_second_period_leaves_the_next_one_on_time() -> None:
    assert picked(Pacer(1000), [0, 1999, 2099]) == [0, 1, 2]


def test_no_time_passes_while_the_hosts_clock_stands_still_or_goes_back() -> None:
    arrivals = [EPOCH_UTIME, EPOCH_UTIME, EPOCH_UTIME - 10, EPOCH_UTIME - 10]
    assert picked(Pacer(1e6), [None] * 4, arrivals) == [0]
