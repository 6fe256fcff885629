"""Rates and bursts, on a clock that the test sets."""

from gateway.runtime.token_bucket import TokenBucket
from tests.support.clocks import Clock


def test_a_bucket_allows_the_amount_of_a_second_at_once_and_then_its_rate(clock: Clock) -> None:
    bucket = TokenBucket(10.0, monotonic=clock)
    assert [bucket.try_take() for _ in range(12)] == [True] * 10 + [False] * 2
    clock.now_s += 0.55
    assert [bucket.try_take() for _ in range(7)] == [True] * 6 + [False]
    clock.now_s += 3600
    assert sum(bucket.try_take() for _ in range(100)) == 10


def test_a_large_amount_is_made_up_for_within_a_second(clock: Clock) -> None:
    bucket = TokenBucket(10.0, monotonic=clock)
    assert bucket.try_take(1_000_000)
    clock.now_s += 0.99
    assert bucket.left <= 0
    clock.now_s += 0.02
    assert bucket.left > 0


def test_a_rate_below_one_allows_one_at_once_or_the_capacity(clock: Clock) -> None:
    bucket = TokenBucket(0.5, monotonic=clock)
    assert [bucket.try_take(), bucket.try_take()] == [True, False]
    clock.now_s += 2.1
    assert bucket.try_take()
    bucket = TokenBucket(10.0, 3, clock)
    assert [bucket.try_take() for _ in range(4)] == [True] * 3 + [False]
    clock.now_s += 3600
    assert bucket.left == 3


def test_what_is_left_at_least_can_be_chosen(clock: Clock) -> None:
    bucket = TokenBucket(1.0, 5.0, clock)
    bucket.take(100)
    assert bucket.left == -5
    bucket.take(100, least=0.0)
    assert bucket.left == 0
    bucket.take(100, least=float("-inf"))
    assert bucket.left == -100
    clock.now_s += 101
    assert bucket.left == 1
