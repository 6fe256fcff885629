"""The questions that wait for an answer, and the queries that ask for each.

Equal queries that arrive before there is an answer are one question.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import zenoh


class SharedQuestion(NamedTuple):
    """What equal queries ask for. They get the same answers."""

    source: str
    selected: str
    options: tuple[tuple[str, str], ...]
    number: int = 0
    """Makes each command a question of its own: a second stop is for what was started after the first one."""

    @property
    def selector(self) -> str:
        """The key and the options."""
        options = ";".join(f"{name}={value}" for name, value in self.options)
        return f"{self.selected}?{options}" if options else self.selected


class OpenQuestions:
    """Takes queries from Zenoh's threads, and lets the event loop start one question after the other.

    ``wake`` is called, in the thread that adds a query, when there is a question to start and the event loop
    does not ask for one already. From then on, it asks with ``start_next`` until that returns None.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self.is_closed = False
        """Whether nobody answers further queries."""
        self._wake = wake
        self._lock = threading.Lock()
        self._queries: dict[SharedQuestion, list[zenoh.Query]] = {}  # until there is an answer, more can join
        self._waiting: deque[SharedQuestion] = deque()  # those of them that are not started
        self._is_awake = False  # the event loop asks for the next question

    def add(self, question: SharedQuestion, query: zenoh.Query) -> bool:
        """Add a query; return False if nobody answers it."""
        with self._lock:
            if self.is_closed:
                return False
            if question in self._queries:
                self._queries[question].append(query)
                return True
            self._queries[question] = [query]
            self._waiting.append(question)
            was_awake, self._is_awake = self._is_awake, True
        if not was_awake:
            self._wake()
        return True

    def start_next(self, *, has_room: bool) -> SharedQuestion | None:
        """Return the question to start now; None if there is none, or no room for its answer."""
        with self._lock:
            if self._waiting and has_room:
                return self._waiting.popleft()
            self._is_awake = False
            return None

    def resume(self) -> bool:
        """Return True if the event loop has to ask again, because a question has waited for room."""
        with self._lock:
            if self._is_awake or not self._waiting:
                return False
            self._is_awake = True
            return True

    def take_queries(self, question: SharedQuestion) -> list[zenoh.Query]:
        """Return the queries that get an answer; equal ones that arrive from now on are another question."""
        with self._lock:
            return self._queries.pop(question)

    def close(self) -> list[tuple[SharedQuestion, list[zenoh.Query]]]:
        """Accept no further queries, and start no further question. Return those that are open."""
        with self._lock:
            self.is_closed = True
            self._waiting.clear()
            return list(self._queries.items())
