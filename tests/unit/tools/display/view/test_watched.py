"""When the view receives: a random schedule against a plain model, and the errors of a new subscription."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import QueryError
from gateway.tools.display.view.watched import LINGER_S, WatchedSubscriber
from tests.unit.tools.display.live_lab import Lab


class World:
    """Pages that come and go, a clock, and gateways that can be reached or not."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.has_page = False
        self.is_reachable = True
        self.num_open = 0
        self.num_ticks = 0
        self.live = Lab().live
        self.watched = WatchedSubscriber(
            self.live, self.subscribe, lambda: self.has_page, monotonic=lambda: self.now_s
        )

    def subscribe(self) -> Any:
        if not self.is_reachable:
            raise QueryError("cannot connect", code="no-connection")
        self.num_open += 1
        return self

    def tick(self) -> None:
        """Of the subscriber."""
        self.num_ticks += 1

    def close(self) -> None:
        """Of the subscriber. A second call for the same one would make the number negative."""
        self.num_open -= 1


@given(
    st.lists(st.tuples(st.booleans(), st.sampled_from([0.03, 1.0, LINGER_S / 2, 2 * LINGER_S])), max_size=30)
)
def test_the_view_receives_while_a_page_is_open_and_a_little_longer(steps: list[tuple[bool, float]]) -> None:
    world = World()
    watched_s = world.now_s
    for world.has_page, pause_s in steps:
        world.now_s += pause_s
        if world.has_page:
            watched_s = world.now_s
        world.watched.tick()
        assert world.num_open == (world.now_s - watched_s <= LINGER_S)
        assert (world.watched.subscriber is None) == (world.num_open == 0)
    world.watched.close()
    world.watched.close()
    assert world.num_open == 0


def test_a_page_that_finds_no_gateway_is_told_once_and_gets_data_later(
    capsys: pytest.CaptureFixture[str],
) -> None:
    world = World()
    world.now_s += 2 * LINGER_S
    world.watched.tick()
    world.has_page, world.is_reachable = True, False
    for _ in range(100):
        world.now_s += 0.1
        world.watched.tick()
    assert capsys.readouterr().err == "cannot connect\n"
    world.is_reachable = True
    world.now_s += 2
    world.watched.tick()
    assert world.num_open == 1


def test_what_was_received_before_a_pause_is_not_shown_after_it() -> None:
    world = World()
    Lab(live=world.live).send_markers(True)
    assert world.live.sources_now
    world.now_s += 2 * LINGER_S
    world.watched.tick()
    world.has_page = True
    world.watched.tick()
    assert not world.live.sources_now
