"""What waits in a join, with frames of the test."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Self

import pytest

from gateway.client import live_join
from gateway.client.live_join import Join


@dataclass
class JoinedFrame:
    """A frame that remembers the others with which it was joined."""

    key: str
    sequence: int
    session: int = 1
    source: str = "lab"
    others: list[Any] = field(default_factory=list)

    @property
    def timestamp_us(self) -> int:
        return 1000 * self.sequence

    def joined(self, others: Iterable[Self]) -> Self:
        self.others = [(other.key, other.sequence) for other in others]
        return self


def add(join: Join, *frames: JoinedFrame) -> None:
    for frame in frames:
        join.add(frame, 0.0)  # type: ignore[arg-type] # it has what a join needs


def test_a_message_that_was_overtaken_does_not_start_the_source_again() -> None:
    """LCM may deliver in another order: what waits would be forgotten each time."""
    join = Join(["lab"], ["3d", "analog"])
    add(join, *(JoinedFrame("3d", number) for number in (0, 2, 1)))
    add(join, *(JoinedFrame("analog", number) for number in range(3)))
    assert [frame.sequence for frame in join.take(0.0)] == [0, 2, 1]
    assert join.num_dropped == 0


def test_if_the_first_component_stops_the_others_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_join, "MAX_FRAMES", 10)
    join = Join(["lab"], ["3d", "analog"])
    add(join, *(JoinedFrame("analog", number) for number in range(30)))
    assert join.num_dropped == 20
    add(join, JoinedFrame("3d", 29))
    [frame] = join.take(0.0)
    assert frame.others == [("analog", number) for number in range(20, 30)]  # type: ignore[attr-defined]
