"""The last seconds, kept in segments and saved by links."""

import asyncio
import itertools
from pathlib import Path

import pytest

from gateway.errors import QueryError
from gateway.messages.decode import decode
from gateway.outputs.contract import ServerParameters
from gateway.outputs.takes import segments
from gateway.outputs.takes.folder import ROLLING
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import log_paths
from tests.recording_output import RecordingLab, frames, recording_lab
from tests.waiting import wait_until_async


@pytest.fixture
def short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "SEGMENT_S", 0.05)


def segment_paths(lab: RecordingLab) -> list[Path]:
    return sorted((lab.directory / ROLLING / "lab").glob("*"))


async def publish_until(lab: RecordingLab, num_segments: int, published: list[bytes]) -> None:
    """Publish until so many segments were begun."""
    seen: set[Path] = set()
    while len(seen) < num_segments:
        published.append(lab.publish())
        seen |= set(segment_paths(lab))
        await asyncio.sleep(0.001)


@pytest.mark.usefixtures("short_segments")
async def test_a_saved_take_has_everything_until_save_and_nothing_after_it(tmp_path: Path) -> None:
    published: list[bytes] = []
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        lab.output.publish_parameters("lab", ServerParameters(b"<a/>", 1, 1))
        await publish_until(lab, 4, published)
        saved = await lab.takes.save("lab", 60, 0, "fall")
        lab.publish()
    assert not saved.is_running
    assert frames(lab.path("fall")) == published
    logs = log_paths(lab.path("fall"))
    assert [path.name for path in logs] == [f"fall-{number:03}.lcmlog" for number in range(1, len(logs) + 1)]
    assert len(logs) >= 4
    for log in logs:  # each is a complete recording
        first, second, *_ = EventLogReader(log).events()
        assert [decode(event.message).__class__.__name__ for event in (first, second)] == [
            "take_t",
            "parameters_t",
        ]
        assert decode(second.message).xml == "<a/>"
    assert saved.num_bytes == sum(log.stat().st_size for log in logs)


@pytest.mark.usefixtures("short_segments")
async def test_saving_makes_links(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        await publish_until(lab, 3, [])
        await lab.takes.save("lab", 60, 0, "fall")
        links = {path.stat().st_ino for path in log_paths(lab.path("fall"))}
        assert links <= {path.stat().st_ino for path in segment_paths(lab)}


@pytest.mark.usefixtures("short_segments")
async def test_a_saved_take_goes_on_for_some_seconds(tmp_path: Path) -> None:
    published: list[bytes] = []
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        await publish_until(lab, 2, published)
        saved = await lab.takes.save("lab", 60, 0.5, "fall")
        assert saved.is_running
        while [take.is_running for take in (await lab.takes.list("lab")).takes] == [True]:
            published.append(lab.publish())
            await asyncio.sleep(0.001)
    found = frames(lab.path("fall"))
    assert found == published[: len(found)]
    assert len(published) - len(found) < 30
    assert len(log_paths(lab.path("fall"))) > 3


@pytest.mark.usefixtures("short_segments")
async def test_only_the_last_seconds_are_kept_and_saved(tmp_path: Path) -> None:
    published: list[bytes] = []
    async with recording_lab(tmp_path, keep_last_s=0.2) as lab:
        await publish_until(lab, 20, published)
        assert len(segment_paths(lab)) < 12
        kept_s = (await lab.takes.list("lab")).kept_s
        await lab.takes.save("lab", 60, 0, "all")
        await lab.takes.save("lab", 0.05, 0, "some")
        await publish_until(lab, 20, [])
    everything, some = frames(lab.path("all")), frames(lab.path("some"))
    assert 0.2 <= kept_s < 2
    assert everything == published[-len(everything) :]
    assert some == published[-len(some) :]
    assert 0 < len(some) < len(everything) < len(published)


@pytest.mark.usefixtures("short_segments")
async def test_any_number_of_takes_can_be_saved_beside_a_running_one(tmp_path: Path) -> None:
    published: list[bytes] = []
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        lab.publish()
        await lab.takes.start("lab", "walk")
        for number in range(5):
            await publish_until(lab, 1, published)
            await lab.takes.save("lab", 60, 30, f"fall {number}")
        names = {take.name for take in (await lab.takes.list("lab")).takes if take.is_running}
        assert names == {"walk", *(f"fall {number}" for number in range(5))}
    assert frames(lab.path("walk.lcmlog")) == published
    assert all(frames(lab.path(f"fall {number}"))[1:] == published for number in range(5))


async def test_saving_needs_something_that_is_kept(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        lab.publish()
        with pytest.raises(QueryError, match="keep_last_s is 0"):
            await lab.takes.save("lab", 60)
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        with pytest.raises(QueryError, match="no messages are kept yet") as nothing:
            await lab.takes.save("lab", 60)
        assert nothing.value.code == "nothing-yet"
        lab.publish()
        for last_s, after_s in ((0.0, 0.0), (-1.0, 0.0), (float("nan"), 0.0), (1.0, -1.0), (1.0, 1e9)):
            with pytest.raises(QueryError, match="expected last above 0"):
                await lab.takes.save("lab", last_s, after_s)
        await lab.takes.save("lab", 60, 0, "fall")
        with pytest.raises(QueryError, match="there is a take 'fall'"):
            await lab.takes.save("lab", 60, 0, "fall")
        with pytest.raises(QueryError, match="there is a take 'fall'"):
            await lab.takes.start("lab", "fall")


async def test_an_orderly_end_deletes_the_segments(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        lab.publish()
        await wait_until_async(lambda: segment_paths(lab))
    assert segment_paths(lab) == []


async def test_segments_of_a_gateway_that_was_killed_become_a_take(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        published = [lab.publish() for _ in range(10)]
        await lab.takes.save("lab", 10, 0, "fall")
        [segment] = log_paths(lab.path("fall"))
    left_behind = tmp_path / ROLLING / "lab" / segment.name
    left_behind.parent.mkdir(parents=True)
    segment.rename(left_behind)
    segment.parent.rmdir()
    async with recording_lab(tmp_path) as lab:
        await wait_until_async(lambda: not left_behind.exists())
        [take] = (await lab.takes.list("lab")).takes
    assert take.name.startswith("lab-20")
    assert frames(lab.path(take.name)) == published


@pytest.mark.usefixtures("short_segments")
async def test_a_segment_that_is_removed_is_replaced(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        published: list[bytes] = []
        await publish_until(lab, 2, published)
        for path in segment_paths(lab):
            path.unlink()
        for _ in itertools.repeat(None, 100):
            published.append(lab.publish())
            await asyncio.sleep(0.005)
        await lab.takes.save("lab", 10, 0, "fall")
    found = frames(lab.path("fall"))
    assert found == published[-len(found) :]
