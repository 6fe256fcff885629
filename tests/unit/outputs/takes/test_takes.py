"""Takes that peers start, stop, list and read."""

import asyncio
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import lcm
import pytest

from gateway.errors import QueryError
from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.contract import ServerFile, ServerParameters
from gateway.outputs.takes.folder import TakesFolder
from gateway.outputs.takes.recorded_takes import MAX_SAVES
from gateway.outputs.takes.stored import MAX_PIECE_BYTES, StoredTake
from gateway.takes.reader import log_paths
from tests.recording_output import RecordingLab, events, frames, recording_lab
from tests.waiting import wait_until_async


async def test_a_take_has_everything_that_is_published_between_start_and_stop(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        lab.publish()
        started = await lab.takes.start("lab", "walk 1")
        published = [lab.publish(key) for _ in range(50) for key in ("3d", "event")]
        stopped = await lab.takes.stop("lab")
        lab.publish()
    path = lab.path("walk 1.lcmlog")
    assert frames(path) == published
    assert (started.name, started.is_running) == ("walk 1", True)
    assert (stopped.name, stopped.is_running, stopped.num_lost) == ("walk 1", False, 0)
    assert (stopped.num_bytes, stopped.begin_utime) == (path.stat().st_size, started.begin_utime)
    channels = [event.channel for event in lcm.EventLog(str(path))]
    assert channels[:3] == ["MOCAP_LAB_TAKE", "MOCAP_LAB_3D", "MOCAP_LAB_EVENT"]


async def test_a_take_begins_with_its_description_and_the_newest_parameters(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        lab.takes.server = lambda source: f"{source}:3020"
        lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
        lab.output.publish_parameters("lab", ServerParameters(b"<new/>\0", 1, 5))
        await lab.takes.start("lab", "walk")
        lab.publish()
        lab.output.publish_parameters("lab", ServerParameters(b"<changed/>", 1, 6))
        lab.publish()
        await lab.takes.stop("lab")
    take, new, first, changed, second = events(lab.path("walk.lcmlog"))
    description = decode(take.message)
    assert (description.name, description.source, description.channels) == ("walk", "lab", "MOCAP_LAB")
    assert description.server == "lab:3020"
    assert (decode(new.message).xml, decode(new.message).parameters_version) == ("<new/>", 5)
    assert (decode(changed.message).xml, decode(changed.message).sequence) == ("<changed/>", 2)
    assert (new.channel, changed.channel) == ("MOCAP_LAB_PARAMETERS", "MOCAP_LAB_PARAMETERS")
    times = [event.utime for event in (take, new, first, changed, second)]
    assert times == sorted(times)


async def test_frames_never_overtake_long_parameters(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("lab", "walk")
        before = lab.publish()
        long = lab.output.publish_parameters("lab", ServerParameters(b"<!--" + b" " * 100_000 + b"-->", 1, 1))
        short = lab.output.publish_parameters("lab", ServerParameters(b"<short/>", 1, 2))
        assert long is not None
        assert short is not None
        await long
        between = lab.publish()
        await short
        after = lab.publish()
        await lab.takes.stop("lab")
    found = [event.message for event in events(lab.path("walk.lcmlog"))[1:]]
    first, long_ones, second, short_ones, last = found
    assert [first, second, last] == [before, between, after] or [first, short_ones, last] == [
        *(before, between, after)
    ]
    assert decode(long_ones).parameters_version == 1


async def test_only_one_take_of_a_source_runs(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        with pytest.raises(QueryError, match="no take of source 'lab' is running") as nothing:
            await lab.takes.stop("lab")
        assert nothing.value.code == "nothing-yet"
        await lab.takes.start("lab", "walk")
        with pytest.raises(QueryError, match="take 'walk' of source 'lab' is running already"):
            await lab.takes.start("lab", "run")
        await lab.takes.stop("lab")
        with pytest.raises(QueryError, match="there is a take 'walk' of this source already"):
            await lab.takes.start("lab", "walk")
        await lab.takes.start("lab", "run")
        with pytest.raises(QueryError, match="no source 'hall'"):
            await lab.takes.start("hall")


async def test_takes_without_a_name_get_one_of_source_and_time(tmp_path: Path) -> None:
    names = []
    async with recording_lab(tmp_path) as lab:
        for _ in range(3):
            names.append((await lab.takes.start("lab")).name)
            await lab.takes.stop("lab")
    assert len(set(names)) == 3
    assert all(name.startswith("lab-20") for name in names)
    assert {path.stem for path in lab.path("").iterdir()} == set(names)


@pytest.mark.parametrize("name", ["a/b", "..", ".x", " x", "x" * 101, "a\nb", "a\0b", "a*b", "/etc/x"])
async def test_names_that_are_no_names_of_files_are_refused(tmp_path: Path, name: str) -> None:
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        lab.publish()
        for call in (
            lab.takes.start("lab", name),
            lab.takes.save("lab", 1, 0, name),
            lab.takes.read("lab", name, 0),
        ):
            with pytest.raises(QueryError, match="cannot be the name of a take") as refused:
                await call
            assert refused.value.code == "bad-request"


async def test_names_may_have_letters_of_any_script(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        for name in ("Käfig 1", "歩行_2", "a+b-c.d"):
            await lab.takes.start("lab", name)
            await lab.takes.stop("lab")
            assert lab.path(f"{name}.lcmlog").is_file()


async def test_a_take_that_ends_while_it_is_listed_is_not_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("lab", "walk")
        loop, take_at = asyncio.get_running_loop(), TakesFolder.take_at
        ends: list[Coroutine[Any, Any, StoredTake]] = []

        async def end() -> None:
            ends.append(lab.takes.end("lab"))

        def end_and_read(folder: TakesFolder, path: Path) -> StoredTake:
            if not ends:
                asyncio.run_coroutine_threadsafe(end(), loop).result()
            return take_at(folder, path)

        monkeypatch.setattr(TakesFolder, "take_at", end_and_read)
        assert (await lab.takes.list("lab")).running is None
        assert (await ends[0]).name == "walk"


async def test_takes_are_listed_and_read_in_pieces(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        await lab.takes.start("lab", "walk")
        for _ in range(100):
            lab.publish(size=1000)
        await lab.takes.stop("lab")
        await lab.takes.save("lab", 60, 0, "fall")
        lab.publish()
        await lab.takes.save("lab", 60, 0, "fall again")
        await lab.takes.start("lab", "run")
        found = await lab.takes.list("lab")
        assert found.running is not None
        assert (found.running.name, found.running.is_running) == ("run", True)
        assert {take.name: take.is_running for take in found.takes} == {
            "walk": False,
            "fall": False,
            "fall again": False,
            "run": True,
        }
        assert found.kept_s > 0
        for name in ("walk", "fall again"):
            [take] = [take for take in found.takes if take.name == name]
            pieces: list[bytes] = []
            while True:
                piece = await lab.takes.read("lab", name, sum(map(len, pieces)))
                assert piece.num_bytes == take.num_bytes
                pieces.append(piece.content)
                if not piece.content:
                    break
            assert len(pieces[0]) == MAX_PIECE_BYTES
            log = lab.path(name) if name == "fall again" else lab.path("walk.lcmlog")
            assert b"".join(pieces) == b"".join(path.read_bytes() for path in log_paths(log))
        with pytest.raises(QueryError, match="has no take 'jump'"):
            await lab.takes.read("lab", "jump", 0)
        assert (await lab.takes.read("lab", "walk", 1 << 60)).content == b""


async def test_components_and_the_prefix_can_be_chosen(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, components=["event"], prefix="HALL") as lab:
        pose = lab.output.publisher(Topic("lab", ("6d", "3d"), "rtc3d.tool_pose_t"))
        status = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
        await lab.takes.start("lab", "walk")
        assert [publisher.wanted for publisher in (*lab.publishers.values(), pose, status)] == [
            *([False] * 4),
            *([True] * 3),
        ]
        lab.publish("3d")
        event = lab.publish("event")
        pose.publish(event)
        late = lab.output.publisher(Topic("lab", ("6d", "3D"), "rtc3d.tool_pose_t"))
        late.publish(event)
        await lab.takes.stop("lab")
        assert not status.wanted
    channels = [event.channel for event in events(lab.path("walk.lcmlog"))]
    assert channels == ["HALL_LAB_TAKE", "HALL_LAB_EVENT", "HALL_LAB_6D_3D", "HALL_LAB_6D_3D_2"]


async def test_a_file_of_the_server_gets_the_name_of_its_take(tmp_path: Path) -> None:
    spool = tmp_path / "spool"
    spool.mkdir()
    file = spool / "lab-1.c3d"
    file.write_bytes(b"c3d")
    takes = tmp_path / "takes"
    takes.mkdir()
    async with recording_lab(takes) as lab:
        lab.output.announce_file("lab", ServerFile(file, 3))  # no take is running
        await lab.takes.start("lab", "walk")
        lab.output.announce_file("lab", ServerFile(file, 3))
        await wait_until_async(lab.path("walk.c3d").exists)
        await lab.takes.stop("lab")
        lab.output.announce_file("lab", ServerFile(file, 3))
        await wait_until_async(lab.path("walk-2.c3d").exists)
    assert lab.path("walk.c3d").samefile(file)
    assert sorted(path.name for path in lab.path("").iterdir()) == ["walk-2.c3d", "walk.c3d", "walk.lcmlog"]


async def test_the_end_of_the_output_ends_the_take(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("lab", "walk")
        published = [lab.publish(size=1000) for _ in range(200)]
    assert frames(lab.path("walk.lcmlog")) == published


async def test_withdrawing_a_source_ends_its_take(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("lab", "walk")
        published = [lab.publish()]
        lab.output.withdraw("lab")
        with pytest.raises(QueryError, match="no source 'lab'"):
            await lab.takes.stop("lab")
        lab.output.announce("lab")
        await lab.takes.start("lab", "run")
    assert frames(lab.path("walk.lcmlog")) == published


async def test_two_gateways_do_not_share_a_folder(tmp_path: Path) -> None:
    async with recording_lab(tmp_path):
        other = RecordingLab(tmp_path)
        other.output.start()
        await wait_until_async(
            lambda: _maintained(other).takes.problem.startswith("another gateway records in")
        )
        other.output.close()


def _maintained(lab: RecordingLab) -> RecordingLab:
    lab.output.maintain()
    return lab


async def test_takes_that_are_being_saved_are_bounded(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        lab.publish()
        for _ in range(MAX_SAVES):
            await lab.takes.save("lab", 30, 60)
        with pytest.raises(QueryError, match="16 takes of source 'lab' are being saved already") as caught:
            await lab.takes.save("lab", 30, 60)
        assert caught.value.code == "refused"
        await lab.takes.save("lab", 30)
