"""Rates, numbers and bytes of questions, on a clock that the test sets."""

from collections import Counter

import pytest

from gateway.errors import QueryError
from gateway.outputs import query_admission as admission_module
from gateway.outputs.query_admission import MAX_KEYS, MAX_STOPS, NO_REPLY, QueryAdmission, QueryLimits
from tests.support.clocks import Clock
from tests.support.errors import names

LIMITS = QueryLimits("zenoh", "max_queries_per_key_per_s", 100.0, 10.0, 1000.0, 40)


@pytest.fixture
def clock() -> Clock:
    return Clock()


def asked(admission: QueryAdmission, key: str, times: int) -> Counter[str]:
    """Ask ``times`` times; return the codes of the refusals; ok is for what was admitted."""
    results: Counter[str] = Counter()
    for _ in range(times):
        refusal = admission.admit("lab", key)
        results["ok" if refusal is None else refusal.error.code] += 1
        if refusal is None:
            admission.finished("lab", "ok")
    return results


def test_each_key_has_its_rate_and_all_together_have_one(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS, clock)
    assert asked(admission, "lab/3d", 30) == {"ok": 10, "rate": 20}
    assert asked(admission, "lab/6d", 10) == {"ok": 10}
    clock.now_s += 0.5
    assert asked(admission, "lab/3d", 30) == {"ok": 5, "rate": 25}
    admission = QueryAdmission(LIMITS, clock)
    together = sum((asked(admission, f"lab/{number}", 2) for number in range(200)), Counter())
    assert together == {"ok": 100, "rate": 300}


def test_an_admitted_question_with_many_answers_counts_as_many(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS, clock)
    assert asked(admission, "lab/**", 1) == {"ok": 1}
    admission.count(99)
    assert asked(admission, "lab/3d", 1) == {"rate": 1}


def test_a_refusal_says_which_limit_and_its_setting(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS, clock)
    asked(admission, "lab/3d", 10)
    refusal = admission.admit("lab", "lab/3d")
    assert refusal
    assert refusal.error.code == "rate"
    assert names(str(refusal.error), 10, "zenoh.max_queries_per_key_per_s")
    for number in range(9):
        asked(admission, f"lab/{number}", 10)
    refusal = admission.admit("lab", "lab/6d")
    assert refusal
    assert names(str(refusal.error), 100, "zenoh.max_queries_per_s")


def test_questions_in_progress_are_limited(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS._replace(pending=3), clock)
    assert [admission.admit("lab", "a") for _ in range(3)] == [None] * 3
    refusal = admission.admit("lab", "b")
    assert refusal is not None
    assert (refusal.error.code, refusal.cause) == ("busy", "queue")
    admission.finished("lab", "ok")
    assert admission.admit("lab", "b") is None
    assert admission.num_pending == 3


def test_a_stop_is_admitted_whatever_else_is_asked(clock: Clock) -> None:
    """A recording must not go on because of a flood of questions. Stops themselves are limited, too."""
    admission = QueryAdmission(LIMITS._replace(pending=3), clock)
    asked(admission, "lab/recording", 10)
    for _ in range(MAX_STOPS + 3):
        assert admission.admit("lab", "lab/recording", is_stop=True) is None
    refusal = admission.admit("lab", "lab/recording", is_stop=True)
    assert refusal is not None
    assert refusal.cause == "queue"
    assert admission.num_pending == MAX_STOPS + 3


def test_refusals_are_limited_and_everything_is_counted(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission_module, "REFUSALS_PER_S", 5.0)
    admission = QueryAdmission(LIMITS, clock)
    assert asked(admission, "lab/3d", 30) == {"ok": 10, "rate": 20}
    assert admission.results == {"lab": {"ok": 10, "rate": 5, NO_REPLY: 15}}


def test_the_number_of_known_keys_is_limited(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS._replace(per_s=1e6), clock)
    asked(admission, "lab/3d", 10)
    for number in range(MAX_KEYS - 1):
        asked(admission, f"hostile/{number}", 1)
    assert asked(admission, "lab/3d", 1) == {"rate": 1}
    for number in range(10 * MAX_KEYS):
        asked(admission, f"hostile/{number}", 1)
    assert len(admission._keys) == MAX_KEYS


def test_the_bytes_of_replies_have_a_rate_and_long_replies_their_own(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS, clock)
    admission.check_reply(999)
    admission.check_reply(999)
    with pytest.raises(QueryError, match=r"zenoh\.max_reply_bytes_per_s") as caught:
        admission.check_reply(1)
    assert caught.value.code == "rate"
    admission.check_reply(10**9, is_long=True)
    clock.now_s += 1.1
    admission.check_reply(1)


def test_results_are_counted_for_each_source_except_empty_ones(clock: Clock) -> None:
    admission = QueryAdmission(LIMITS, clock)
    for source, result in (("lab", "ok"), ("hall", "nothing-yet"), ("lab", "ok"), ("lab", "")):
        admission.admit(source, f"{source}/3d")
        admission.finished(source, result)
    assert (admission.num_pending, admission.results) == (0, {"lab": {"ok": 2}, "hall": {"nothing-yet": 1}})
