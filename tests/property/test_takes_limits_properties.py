"""The limits of the folder of takes, with clocks that are wrong in any way that happens to a computer."""

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.outputs.takes.disk import FolderWatch, Host
from gateway.outputs.takes.folder_clock import STEP_S
from tests.support.clocks import Clock
from tests.support.examples import examples
from tests.support.recording_output import NoThread, settings_in

DAY_S = 86_400.0
MAX_AGE_S = 7 * DAY_S
MAX_BYTES = 3000
TAKE_BYTES = 1000
BEGIN_S = 1_700_000_000.0


class Lab:
    """A computer with a gateway: its true time, its clock, and when each take was really written."""

    def __init__(self, directory: Path, max_bytes: int) -> None:
        self.directory = directory
        self.max_bytes = max_bytes
        self.true_s = BEGIN_S
        self.error_s = 0.0
        self.wrong_s = 0.0  # for how long the clock has been ahead by a credible time
        self.written: dict[Path, float] = {}  # when each take was really written
        self.copied: set[Path] = set()
        self.num_takes = 0
        self.monotonic = Clock()
        (directory / "lab").mkdir()
        self.start()

    def start(self) -> None:
        """Start another gateway."""
        host = Host(self.monotonic, lambda: self.true_s + self.error_s, NoThread)
        self.watch = FolderWatch(settings_in(self.directory), host)
        self.check()

    def check(self, *protected: Path) -> int:
        """Check the folder; return how many bytes are too many."""
        paths = {path.with_suffix("") for path in protected}
        excess = self.watch.delete_old(self.max_bytes, MAX_AGE_S, paths)
        for path in [*self.written]:
            if not path.exists():
                age_s = self.true_s - self.written.pop(path)
                if self.max_bytes > MAX_BYTES and path not in self.copied:
                    assert age_s >= MAX_AGE_S - STEP_S, f"{path} is deleted after {age_s / DAY_S:.1f} days"
        return excess

    def take(self, is_copied_with_s: float | None = None) -> None:
        """Record a take, or copy one that has a time, relative to now."""
        path = self.directory / "lab" / f"{self.num_takes}.lcmlog"
        self.num_takes += 1
        path.write_bytes(bytes(TAKE_BYTES))
        self.written[path] = self.true_s
        end_s = self.true_s + (self.error_s if is_copied_with_s is None else is_copied_with_s)
        os.utime(path, (end_s, end_s))
        if is_copied_with_s is not None:
            self.copied.add(path)
        excess = self.check(path)
        assert not excess, "a new take ends, although others can be deleted"
        self.wait(10)
        if path in self.written:
            assert path.exists()

    def wait(self, seconds: float) -> None:
        """Let the gateway run, with checks in between."""
        for _ in range(4):
            self.true_s += seconds / 4
            self.monotonic.now_s += seconds / 4
            self.wrong_s += seconds / 4
            if 0 < self.error_s <= 32 * DAY_S and self.wrong_s > 1800:
                self.error_s = 0.0  # somebody sees it
            self.check()

    def off(self, seconds: float) -> None:
        """Switch the computer off.

        A clock that is behind until then leaves no trace of when takes were recorded, so it is set before.
        """
        if self.error_s < 0:
            self.set_clock(0)
        self.true_s += seconds
        self.monotonic.now_s = 10.0
        self.start()

    def set_clock(self, error_s: float) -> None:
        """Change the error of the clock."""
        self.error_s, self.wrong_s = error_s, 0.0
        self.check()


def action(name: str, *arguments: float) -> st.SearchStrategy[tuple[str, float]]:
    return st.tuples(st.just(name), st.sampled_from(arguments))


ACTIONS = st.one_of(
    action("take", 0),
    action("take", 0),
    action("copy", -30 * DAY_S, 9e8),
    action("wait", 60, 4000, DAY_S, 8 * DAY_S),
    action("off", 0, 3600, 3 * DAY_S, 20 * DAY_S, 60 * DAY_S),
    action(
        "clock", *(0, 0, 3 * DAY_S, 30 * DAY_S, 365 * DAY_S, 9e8, -3 * DAY_S, -30 * DAY_S, 1000 - BEGIN_S)
    ),
)


def run(actions: list[tuple[str, float]], max_bytes: int) -> Lab:
    """Run the actions in a new folder."""
    with TemporaryDirectory() as folder:
        lab = Lab(Path(folder), max_bytes)
        functions: dict[str, Callable[[float], None]] = {
            "take": lambda _: lab.take(),
            "copy": lab.take,
            "wait": lab.wait,
            "off": lab.off,
            "clock": lab.set_clock,
        }
        for name, argument in actions:
            functions[name](argument)
        return lab


@settings(max_examples=examples(100))
@given(st.lists(ACTIONS, min_size=8, max_size=25))
def test_no_take_is_deleted_by_age_before_its_time(actions: list[tuple[str, float]]) -> None:
    """What was recorded last week must be there, whatever the clock has shown since then."""
    run(actions, 10**9)


@settings(max_examples=examples(100))
@given(st.lists(ACTIONS, min_size=8, max_size=25))
def test_a_new_take_always_finds_room(actions: list[tuple[str, float]]) -> None:
    """Takes from the future or from 1970 can be deleted as others."""
    run(actions, MAX_BYTES)


def test_with_a_right_clock_each_take_is_deleted_in_time() -> None:
    """The protection against wrong clocks must not keep what has to be deleted."""
    lab = run([("take", 0), ("off", 20 * DAY_S), ("wait", 4000), ("take", 0), ("wait", 8 * DAY_S)], 10**9)
    assert not lab.written
