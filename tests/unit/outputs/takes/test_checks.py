"""The doctor's checks of the takes: what a user learns before a recording fails."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError

from gateway.outputs.findings import MessageLoad
from gateway.outputs.takes.checks import check_takes
from tests.support.errors import names
from tests.support.recording_output import settings_in
from tests.unit.outputs.takes.test_segments import no_links

LOADS = [MessageLoad(100.0, 10_000), MessageLoad(500.0, 2_000)]
"""Together 2 MB/s: 7.2 GB an hour."""


def results(directory: Path, loads: list[MessageLoad] = LOADS, **settings: Any) -> list[str]:
    return [finding.result.value for finding in check_takes(settings_in(directory, **settings), [], loads, 1)]


@pytest.mark.parametrize(
    ("free_bytes", "max_bytes", "loads", "result", "values"),
    [
        (7_200_000_000, 10**12, LOADS, "green", ["disk", "60 minutes"]),
        (7_100_000_000, 10**12, LOADS, "warning", ["disk", "59 minutes"]),
        (10**12, 7_100_000_000, LOADS, "warning", ["takes.max_bytes", "59 minutes"]),
        (10**12, 10**12, [], "green", ["unknown"]),
    ],
)
def test_less_than_an_hour_of_room_is_a_warning(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    free_bytes: int,
    max_bytes: int,
    loads: list[MessageLoad],
    result: str,
    values: list[str],
) -> None:
    """The user learns before the measurement how long it may last, and which limit ends it."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=free_bytes))
    _, space, _ = check_takes(settings_in(tmp_path, max_bytes=max_bytes), [], loads, 1)
    assert space.result.value == result
    assert names(space.found, *values)


def test_the_folder_and_its_links_are_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The checks leave nothing behind, and say what the gateway itself would find later."""
    assert results(tmp_path / "new") == ["note", "not tested", "not tested"]
    (tmp_path / "file").touch()
    assert results(tmp_path / "file") == ["red", "not tested", "not tested"]
    (tmp_path / "takes").mkdir()
    assert results(tmp_path / "takes", [])[::2] == ["green", "not tested"]
    assert results(tmp_path / "takes", [], keep_last_s=10)[::2] == ["green", "green"]
    monkeypatch.setattr(os, "link", no_links)
    assert results(tmp_path / "takes", [], keep_last_s=10)[::2] == ["green", "red"]
    assert [*(tmp_path / "takes").iterdir()] == []


@pytest.mark.parametrize("missing", ["start_event_id", "stop_event_id"])
def test_takes_that_follow_events_need_both_events(tmp_path: Path, missing: str) -> None:
    """Without the second one, a take would never end."""
    ids = {"start_event_id": 5, "stop_event_id": 5} | {missing: None}
    with pytest.raises(ValidationError, match=missing):
        settings_in(tmp_path, follow="events", **ids)
