import math
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from gateway.outputs.pacing import Pacer

EPOCH_UTIME = 1_700_000_000_000_000

server_rates_hz = st.floats(1, 2000) | st.sampled_from([30, 60, 100, 120, 200, 300, 400, 1000])
shares = st.floats(0.01, 1) | st.fractions(0, 1, max_denominator=60).filter(bool).map(float)


def picked(pacer: Pacer, timestamps_us: list[int]) -> list[int]:
    return [index for index, stamp in enumerate(timestamps_us) if pacer.due(stamp, EPOCH_UTIME)]


def stamps(rate_hz: float, frames: int, start_us: int) -> list[int]:
    return [start_us + round(index * 1e6 / rate_hz) for index in range(frames)]


@given(server_rates_hz, shares, st.integers(1, 1000), st.integers(-(2**62), 2**62))
def test_counts_and_gaps_are_the_floor_or_the_ceiling(
    rate_hz: float, share: float, frames: int, start_us: int
) -> None:
    indices = picked(Pacer(rate_hz * share), stamps(rate_hz, frames, start_us))
    nearly = 1e-9  # in frames: the rates are not exact in binary
    assert math.floor(frames * share - nearly) <= len(indices) <= math.ceil(frames * share + nearly)
    shortest, longest = math.floor(1 / share + nearly), math.ceil(1 / share - nearly)
    assert all(shortest <= after - before <= longest for before, after in pairwise(indices))


@given(server_rates_hz, st.floats(1, 1000), st.integers(1, 300))
def test_a_limit_above_the_rate_picks_all_frames(rate_hz: float, factor: float, frames: int) -> None:
    assert picked(Pacer(rate_hz * factor), stamps(rate_hz, frames, 0)) == list(range(frames))


@given(st.integers(1, 20), st.integers(0, 2**20), st.data())
def test_jitter_of_a_twentieth_of_a_frame_does_not_change_even_gaps(
    divisor: int, start_us: int, data: st.DataObject
) -> None:
    exact = stamps(200, 100, start_us)
    jitter = data.draw(st.lists(st.integers(-250, 250), min_size=100, max_size=100))
    jittered = [stamp + by_us for stamp, by_us in zip(exact, jitter, strict=True)]
    assert picked(Pacer(200 / divisor), jittered) == list(range(0, 100, divisor))


nonsense = st.lists(st.tuples(st.none() | st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**60)))


@given(nonsense, server_rates_hz, shares, st.integers(0, 500))
def test_the_rate_is_right_at_once_after_any_time_stamps(
    before: list[tuple[int | None, int]], rate_hz: float, share: float, frames: int
) -> None:
    pacer = Pacer(rate_hz * share)
    for timestamp_us, arrival_utime in before:
        pacer.due(timestamp_us, arrival_utime)
    indices = picked(pacer, stamps(rate_hz, frames, 2**63))
    # The pacer restarts with the first frame and knows the spacing from the third on. It may also leave out
    # a frame that is early by more than a quarter of the spacing, so up to three quarters may be missing.
    assert frames * share - 2.75 <= len(indices) <= frames * share + 2
