"""When the folder of takes is checked again."""

from pathlib import Path

import pytest

from gateway.outputs.takes import folder_watch
from gateway.outputs.takes.folder_watch import FolderWatch
from gateway.outputs.takes.settings import TakesSettings


class SlowChecks:
    """A clock by which each check takes a second."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def monotonic(self) -> float:
        self._now_s += 1.0
        return self._now_s


@pytest.fixture
def settings(tmp_path: Path) -> TakesSettings:
    return TakesSettings.model_validate({"enabled": True, "directory": str(tmp_path)})


def test_after_a_slow_check_the_disk_rests(settings: TakesSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = FolderWatch(settings)
    monkeypatch.setattr(folder_watch, "time", SlowChecks())
    watch._check_now(settings, frozenset())
    assert watch._next_check_s == 2.0 + 50.0
    watch.folder.close()


def test_after_a_problem_the_folder_is_checked_soon(
    settings: TakesSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    former, watch = FolderWatch(settings), FolderWatch(settings)
    former._check_now(settings, frozenset())
    monkeypatch.setattr(folder_watch, "time", SlowChecks())
    watch._check_now(settings, frozenset())
    assert "another gateway records" in watch._problem
    assert watch._next_check_s == 2.0
    former.folder.close()
    watch._check_now(settings, frozenset())
    assert not watch._problem
    watch.folder.close()


def test_a_check_after_the_end_does_not_lock_the_folder_again(settings: TakesSettings) -> None:
    former, watch = FolderWatch(settings), FolderWatch(settings)
    former._check_now(settings, frozenset())
    former.folder.close()
    former._check_now(settings, frozenset())
    watch._check_now(settings, frozenset())
    assert not watch._problem
    watch.folder.close()
