"""The rolling segments against a plain list of messages, whatever is saved, removed or deleted meanwhile."""

import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import QueryError
from gateway.outputs.takes.folder import TakesFolder
from gateway.outputs.takes.segments import Save
from tests.support.examples import examples
from tests.unit.outputs.takes.test_segments import Rolling, numbers

KEEP_S = 30.0


@pytest.fixture(scope="module", autouse=True)
def _quick_disk() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield


class Model:
    """When each message was written, and which of them nobody can expect any more."""

    def __init__(self, folder: Path) -> None:
        self.rolling = Rolling(folder, KEEP_S)
        self.times: list[float] = []
        self.removed: set[int] = set()  # by somebody
        self.deleted: set[int] = set()  # to make room
        self.saves: list[
            tuple[Save, set[int], set[int]]
        ] = []  # that go on, with what they must have, and lack
        self.num_saves = 0

    @property
    def stored(self) -> set[int]:
        """The messages in the files."""
        return {number for path in self.rolling.files for number in numbers(path)}

    def due(self, last_s: float) -> set[int]:
        """The messages of the last seconds that are kept."""
        since_s = self.rolling.clock() - min(last_s, KEEP_S)
        return {number for number, time_s in enumerate(self.times) if time_s >= since_s} - self.deleted

    def write(self, count: int) -> None:
        """Write messages, one per second."""
        for _ in range(count):
            for _, due, _ in self.saves:
                due.add(len(self.times))
            self.times.append(self.rolling.clock())
            self.rolling.write(1)

    def wait(self, seconds: int) -> None:
        """Nothing arrives."""
        self.rolling.clock.now_s += seconds

    def remove(self, place: int) -> None:
        """Somebody removes a file, which is noticed within half a second, at the next ``sync``."""
        files = self.rolling.files
        if files:
            path = files[place % len(files)]
            self.removed.update(numbers(path))
            path.unlink()
            self.rolling.segments.sync()

    def shorten(self, _: int) -> None:
        """The folder is full."""
        before = self.stored
        self.rolling.segments.shorten()
        left = self.stored
        dropped = before - left
        assert not dropped or not left or max(dropped) < min(left)
        self.deleted |= set(range(min(left, default=len(self.times))))

    def save(self, last_s: int) -> None:
        """Save the last seconds, every second time with what is to come."""
        self.num_saves += 1
        due, goes_on = self.due(last_s), bool(last_s % 2)
        try:
            save = self.rolling.save(last_s, f"take{self.num_saves}", goes_on=goes_on)
        except (QueryError, FileNotFoundError):
            assert due <= self.removed
            return
        if goes_on:
            self.saves.append((save, due, due & self.removed))
        else:
            self.check_take(save, due, due & self.removed)

    def end(self, place: int) -> None:
        """End a take that goes on."""
        if self.saves:
            save, due, removed = self.saves.pop(place % len(self.saves))
            self.rolling.segments.end_save(save)
            self.check_take(save, due, removed)

    def check_take(self, save: Save, due: set[int], removed: set[int]) -> None:
        """A take has each message once, in order, and counts those that it lacks."""
        found = numbers(save.folder)
        assert found == sorted(set(found))
        missing = due - set(found)
        # What is removed after the present segment was linked is still there, under the name of the take.
        assert missing <= removed | self.removed
        take = TakesFolder(self.rolling.takes.parent).take_at(save.folder)
        assert not take.is_cut_off
        assert take.num_lost >= len(missing)
        assert take.num_lost <= len(self.removed)

    def check(self) -> None:
        """What is younger than KEEP_S is stored, and not much more."""
        stored = self.stored
        assert self.due(KEEP_S) - stored <= self.removed
        assert len(self.rolling.files) <= KEEP_S // 10 + 2 + self.num_saves + len(self.removed)


ACTIONS = st.tuples(
    st.sampled_from(["write", "write", "write", "wait", "remove", "shorten", "save", "save", "end"]),
    st.integers(0, 25),
)


@settings(max_examples=examples(100))
@given(st.lists(ACTIONS, min_size=5, max_size=25))
def test_segments_keep_and_save_what_a_list_would(actions: list[tuple[str, int]]) -> None:
    """The last seconds before a fall must be there, complete, or counted as lost."""
    with TemporaryDirectory() as folder:
        model = Model(Path(folder))
        for name, number in actions:
            getattr(model, name)(number)
            model.check()
        while model.saves:
            model.end(0)
        model.rolling.segments.close()
        assert model.rolling.files == []
