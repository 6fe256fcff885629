"""The questions that wait for an answer: no query is forgotten, and no question answered twice."""

import random
from typing import Any
from unittest.mock import Mock

import pytest

from gateway.outputs.zenoh.open_questions import OpenQuestions, SharedQuestion

MAX_STARTED = 2


def question(number: int) -> SharedQuestion:
    return SharedQuestion("lab", f"mocap/lab/{number}", ())


class EventLoop:
    """Starts questions as ZenohAnswers does, one in each turn, and at most MAX_STARTED at a time."""

    def __init__(self) -> None:
        self.questions = OpenQuestions(self._call)
        self.num_calls = 0
        self.started: list[SharedQuestion] = []

    def _call(self) -> None:
        self.num_calls += 1
        assert self.num_calls == 1, "two turns would start questions twice as fast"

    def turn(self) -> None:
        """Start the next question, if that is due."""
        if self.num_calls:
            self.num_calls = 0
            found = self.questions.start_next(has_room=len(self.started) < MAX_STARTED)
            if found is not None:
                self.started.append(found)
                assert len(self.started) <= MAX_STARTED
                self._call()

    def answer(self) -> tuple[SharedQuestion, list[Any]]:
        """Answer the oldest question that was started; return it and the queries that get the answer."""
        answered = self.started.pop(0)
        queries = self.questions.take_queries(answered)
        if self.questions.resume():
            self._call()
        return answered, list(queries)


@pytest.mark.parametrize("seed", range(50))
def test_every_query_gets_one_answer_in_whatever_order_things_happen(seed: int) -> None:
    """A question that is left waiting would be answered only when another one comes."""
    schedule, loop = random.Random(seed), EventLoop()
    asked: dict[SharedQuestion, list[Any]] = {}

    def answer() -> None:
        answered, queries = loop.answer()
        assert queries == asked.pop(answered)

    for _ in range(200):
        step = schedule.choice(("ask", "turn", "answer"))
        if step == "ask":
            query, asks_for = Mock(), question(schedule.randrange(6))
            assert loop.questions.add(asks_for, query)
            asked.setdefault(asks_for, []).append(query)
        elif step == "turn":
            loop.turn()
        elif loop.started:
            answer()
    while loop.num_calls or loop.started:
        loop.turn()
        if loop.started:
            answer()
    assert not asked


def test_after_the_end_queries_are_refused_and_the_open_ones_returned() -> None:
    """They must be dropped, so that peers see that no reply follows."""
    questions = OpenQuestions(lambda: None)
    first, second = Mock(), Mock()
    assert questions.add(question(1), first)
    assert questions.add(question(2), second)
    assert questions.start_next(has_room=True) == question(1)
    assert questions.close() == [(question(1), [first]), (question(2), [second])]
    assert not questions.add(question(1), Mock())
    assert questions.start_next(has_room=True) is None
    assert questions.take_queries(question(1)) == [first]
