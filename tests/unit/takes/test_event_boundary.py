"""The end of the last complete event in bytes that arrive in pieces."""

import pytest

from gateway.takes.event_log import EventBoundary, encode_event

EVENTS = [encode_event(number, number, b"MOCAP_LAB_3D", b"x" * number) for number in range(50)]
LOG = b"".join(EVENTS)


@pytest.mark.parametrize("size", [1, 7, 28, 29, 41, 1000, len(LOG)])
def test_the_boundary_is_found_in_pieces_of_any_size(size: int) -> None:
    for end in (0, 1, 27, 28, len(EVENTS[0]) - 1, len(EVENTS[0]), len(LOG) - 1, len(LOG)):
        boundary = EventBoundary()
        for start in range(0, end, size):
            boundary.feed(LOG[start : min(start + size, end)])
        sizes = [sum(map(len, EVENTS[:number])) for number in range(len(EVENTS) + 1)]
        assert boundary.complete_bytes == max(each for each in sizes if each <= end)


def test_after_damage_everything_counts() -> None:
    boundary = EventBoundary()
    boundary.feed(LOG + b"damage" * 10)
    boundary.feed(LOG[:-1])
    assert boundary.complete_bytes == 2 * len(LOG) + 59
