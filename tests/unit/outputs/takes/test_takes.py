"""Takes that peers start, stop, save, list and read, without threads: the disk answers at once."""

import asyncio
import contextlib
import math
import socket
from collections.abc import Callable, Collection, Coroutine
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NoReturn

import lcm
import pytest

from gateway.errors import OutputError, QueryError
from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.contract import ServerFile, ServerParameters
from gateway.outputs.takes import source_takes as takes_module
from gateway.outputs.takes.folder import StoredTake, TakesFolder
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.source_takes import MAX_SAVES
from gateway.takes import open_take
from gateway.takes.files.description import NO_DETAILS, TakeDetails
from gateway.takes.files.statistics import take_statistics
from tests.support.clocks import Clock, run_in_virtual_time
from tests.support.recording_output import events, frames, still_lab


async def refused(text: str, call: Callable[..., Any], *arguments: Any) -> str:
    """Make a call that is refused with this text; return the code of the error."""
    with pytest.raises(QueryError, match=text) as caught:
        await call(*arguments)
    return caught.value.code


async def test_a_take_has_everything_that_is_published_between_start_and_stop(tmp_path: Path) -> None:
    """No message more or less, in LCM's own format, and the peer learns what is on the disk."""
    async with still_lab(tmp_path) as lab:
        lab.publish()
        started = await lab.takes.start("walk 1")
        published = [lab.publish(key) for _ in range(50) for key in ("3d", "event")]
        stopped = await lab.takes.stop()
        lab.publish()
        path = lab.path("walk 1.lcmlog")
        assert frames(path) == published
    assert (started.name, started.is_running) == ("walk 1", True)
    assert (stopped.name, stopped.is_running, stopped.num_lost) == ("walk 1", False, 0)
    assert (stopped.num_bytes, stopped.begin_utime) == (path.stat().st_size, started.begin_utime)
    channels = [event.channel for event in lcm.EventLog(str(path))]
    assert channels[:3] == ["MOCAP_LAB_TAKE", "MOCAP_LAB_3D", "MOCAP_LAB_EVENT"]


async def test_a_take_begins_with_its_description_and_the_newest_parameters(tmp_path: Path) -> None:
    """A file explains itself: whoever reads it needs no other one."""
    async with still_lab(tmp_path) as lab:
        lab.output.storage.server = lambda source: f"{source}:3020"
        lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
        lab.output.publish_parameters("lab", ServerParameters(b"<new/>\0", 1, 5))
        await lab.takes.start("walk")
        lab.publish()
        lab.output.publish_parameters("lab", ServerParameters(b"<changed/>", 1, 6))
        lab.publish()
    found = events(lab.path("walk.lcmlog"))
    ends = ("TAKE", "PARAMETERS", "3D", "PARAMETERS", "3D")
    assert [event.channel for event in found] == [f"MOCAP_LAB_{end}" for end in ends]
    take, new, _, changed, _ = (decode(event.message) for event in found)
    assert (take.name, take.source, take.channels) == ("walk", "lab", "MOCAP_LAB")
    assert (take.server, take.host) == ("lab:3020", socket.gethostname())
    assert (new.xml, new.parameters_version) == ("<new/>", 5)
    assert (changed.xml, changed.sequence) == ("<changed/>", 2)
    times = [event.utime for event in found]
    assert times == sorted(times)


async def test_what_a_take_is_about_is_in_its_file_and_its_list(tmp_path: Path) -> None:
    """A year later, nobody knows whose steps these were; the file and the list say it."""
    about = TakeDetails("S01", "baseline", "left knee; 50 %")
    async with still_lab(tmp_path) as lab:
        started = await lab.takes.start("walk", about)
        lab.publish()
        await lab.takes.stop()
        await lab.takes.start("silent")
        await lab.takes.stop()
        listed = {take.name: take.details for take in (await lab.takes.list()).takes}
    assert started.details == about
    assert listed == {"walk": about, "silent": NO_DETAILS}
    path = lab.path("walk.lcmlog")
    assert [event.channel for event in events(path)[:2]] == ["MOCAP_LAB_TAKE", "MOCAP_LAB_DETAILS"]
    assert open_take(path).sources["lab"].details == about
    assert take_statistics(path).sources["lab"].origin.details == about


async def test_parameters_stay_in_order_although_long_ones_are_encoded_elsewhere(tmp_path: Path) -> None:
    """Short parameters that overtake long ones would be replaced by what they have replaced."""
    async with still_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        before = lab.publish()
        long = lab.output.publish_parameters("lab", ServerParameters(b"<!--" + b" " * 100_000 + b"-->", 1, 1))
        short = lab.output.publish_parameters("lab", ServerParameters(b"<short/>", 1, 2))
        assert long is not None
        assert short is not None
        await asyncio.gather(long, short)
        assert lab.output.publish_parameters("lab", ServerParameters(b"<later/>", 1, 3)) is None
        after = lab.publish()
    found = [event.message for event in events(lab.path("walk.lcmlog"))[1:]]
    assert [found[0], found[-1]] == [before, after]
    assert [decode(message).parameters_version for message in found[1:-1]] == [1, 2, 3]


async def test_parameters_that_do_not_fit_into_the_queue_follow_later(tmp_path: Path) -> None:
    """Without them, the labels of all that follows would be wrong; and they follow once only."""
    async with still_lab(tmp_path, max_queued_bytes=2000) as lab:
        await lab.takes.start("walk")
        lab.output.publish_parameters("lab", ServerParameters(b"<!--" + b" " * 5000 + b"-->", 1, 1))
        lab.output.maintain()
        lab.output.publish_parameters("lab", ServerParameters(b"<!--" + b" " * 1500 + b"-->", 1, 2))
        lab.output.publish_parameters("lab", ServerParameters(b"<!--" + b" " * 1501 + b"-->", 1, 3))
        await lab.output.storage.written()
        for _ in range(3):
            lab.output.maintain()
            await lab.output.storage.written()
    found = [decode(event.message).parameters_version for event in events(lab.path("walk.lcmlog"))[1:]]
    assert found == [2, 3]


async def test_only_one_take_of_a_source_runs(tmp_path: Path) -> None:
    """What is not possible is refused with a reason, and harms neither a file nor the running take."""
    async with still_lab(tmp_path) as lab:
        takes = lab.takes
        assert await refused("no take of", takes.stop) == "nothing-yet"
        await takes.start("walk")
        await refused("take 'walk' of source 'lab' is running already", takes.start, "run")
        published = lab.publish()
        await takes.stop()
        await refused("there is a take 'walk' of this source already", takes.start, "walk")
        await takes.start("run")
        await refused("no source 'hall'", lab.output.takes, "hall")
    assert frames(lab.path("walk.lcmlog")) == [published]


@pytest.mark.parametrize("name", ["a/b", "..", ".x", " x", "x" * 101, "a\nb", "a\0b", "a*b", "/etc/x"])
async def test_names_that_are_no_names_of_files_are_refused(tmp_path: Path, name: str) -> None:
    """Peers must not write outside the folder."""
    async with still_lab(tmp_path, keep_last_s=10) as lab:
        lab.publish()
        takes = lab.takes
        for call, *arguments in ((takes.start, name), (takes.save, 1, 0, name), (takes.read, name, 0)):
            text = "cannot be the name of a take"
            assert await refused(text, call, *arguments) == "bad-request"


async def test_names_may_have_letters_of_any_script_or_follow_from_source_and_time(tmp_path: Path) -> None:
    """Names are for people; without one, three takes in the same second have different names."""
    given = ["Käfig 1", "歩行_2", "a+b-c.d", "x" * 100]
    async with still_lab(tmp_path) as lab:
        names = []
        for name in (*given, "", "", ""):
            names.append((await lab.takes.start(name)).name)
            await lab.takes.stop()
        assert names[:4] == given
        assert all(name.startswith("lab-20") for name in names[4:])
        assert {path.stem for path in lab.path("").iterdir()} == set(names)
        assert len(set(names)) == 7


async def test_takes_are_listed_and_read(tmp_path: Path) -> None:
    """The list tells which takes are complete; reading one gives the bytes on the disk."""
    async with still_lab(tmp_path, Clock(), keep_last_s=60) as lab:
        await lab.takes.start("walk")
        for _ in range(100):
            lab.publish(size=1000)
        await lab.takes.stop()
        await lab.takes.save(60, 0, "fall")
        lab.publish()
        saving = await lab.takes.save(60, 30, "long fall")
        assert (saving.is_running, saving.is_cut_off) == (True, False)
        await lab.takes.start("run")
        found = await lab.takes.list()
        assert found.running is not None
        assert (found.running.name, found.running.is_running) == ("run", True)
        assert not any(take.is_cut_off for take in [found.running, *found.takes])
        running = {take.name: take.is_running for take in found.takes}
        assert running == {"walk": False, "fall": False, "long fall": True, "run": True}
        [walk] = [take for take in found.takes if take.name == "walk"]
        pieces: list[bytes] = []
        while (piece := await lab.takes.read("walk", sum(map(len, pieces)))).content:
            assert piece.num_bytes == walk.num_bytes
            pieces.append(piece.content)
        assert b"".join(pieces) == lab.path("walk.lcmlog").read_bytes()
        assert len(pieces) > 1
        await refused("has no take 'jump'", lab.takes.read, "jump", 0)
        await refused("an offset of 0 or more", lab.takes.read, "walk", -1)


async def test_a_take_that_ends_while_listed_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is read without blocking the event loop, so anything may have changed since."""
    async with still_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        listed = TakesFolder.takes
        ends: list[Coroutine[Any, Any, StoredTake]] = []

        def end_and_list(folder: TakesFolder, source: str, running: Collection[str]) -> list[StoredTake]:
            ends.append(lab.takes.stop())
            return listed(folder, source, running)

        monkeypatch.setattr(TakesFolder, "takes", end_and_list)
        assert (await lab.takes.list()).running is None
        assert (await ends[0]).name == "walk"


async def test_a_take_is_listed_while_its_file_is_gone(tmp_path: Path) -> None:
    """Somebody has removed it, and nothing has arrived since; the other takes must be listed, too."""
    async with still_lab(tmp_path) as lab:
        await lab.takes.start("fall")
        await lab.takes.stop()
        await lab.takes.start("walk", TakeDetails("S01"))
        lab.path("walk.lcmlog").unlink()
        listed = await lab.takes.list()
        assert listed.running is not None
        assert (listed.running.name, listed.running.details.subject) == ("walk", "S01")
        assert [take.name for take in listed.takes] == ["fall"]


@pytest.mark.parametrize("is_folder", [False, True])
async def test_a_take_goes_on_under_another_name_if_something_is_in_its_place(
    tmp_path: Path, is_folder: bool
) -> None:
    """A backup may move a file and put a copy there (mv, cp): nothing that comes later may be lost."""
    clock = Clock()
    async with still_lab(tmp_path, clock) as lab:
        await lab.takes.start("walk")
        before = lab.publish()
        lab.output.storage.started_writer().call(lambda: None)
        lab.path("walk.lcmlog").rename(tmp_path / "moved.lcmlog")
        if is_folder:
            lab.path("walk.lcmlog").mkdir()
        else:
            lab.path("walk.lcmlog").write_bytes((tmp_path / "moved.lcmlog").read_bytes())
        assert lab.takes.take is not None
        lab.takes.take.sync()
        after = [lab.publish(), lab.publish()]
        listed = await lab.takes.list()
        stopped = await lab.takes.stop()
        assert listed.running is not None
    assert (stopped.name, stopped.num_lost, stopped.is_cut_off) == ("walk-2", 0, False)
    assert frames(lab.path("walk-2.lcmlog")) == after
    assert frames(tmp_path / "moved.lcmlog") == [before]


async def test_a_take_that_starts_too_late_has_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The peer was told that there is none; it would be recorded for ever, as nobody knows of it."""

    async def too_late(_created: Future[None], *_others: object) -> NoReturn:
        raise QueryError("the disk did not respond", code="disk")

    async with still_lab(tmp_path) as lab:
        with monkeypatch.context() as patch:
            patch.setattr(takes_module, "disk_result", too_late)
            await refused("did not respond", lab.takes.start, "walk")
        assert [*lab.path("").iterdir()] == []
        assert not lab.publishers["3d"].wanted
        assert not lab.is_recording()
        await lab.takes.start("walk")


async def test_components_and_the_prefix_can_be_chosen(tmp_path: Path) -> None:
    """Status and poses are always recorded; each publisher has a channel of its own."""
    async with still_lab(tmp_path, components=["event"], prefix="HALL") as lab:
        pose = lab.output.publisher(Topic("lab", ("6d", "3d"), "rtc3d.tool_pose_t"))
        status = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
        await lab.takes.start("walk")
        wanted = [publisher.wanted for publisher in (*lab.publishers.values(), pose, status)]
        assert wanted == [*([False] * 4), *([True] * 3)]
        lab.publish("3d")
        event = lab.publish("event")
        pose.publish(event)
        late = lab.output.publisher(Topic("lab", ("6d", "3D"), "rtc3d.tool_pose_t"))
        late.publish(event)
        await lab.takes.stop()
        assert not status.wanted
    channels = [event.channel for event in events(lab.path("walk.lcmlog"))]
    assert channels == ["HALL_LAB_TAKE", "HALL_LAB_EVENT", "HALL_LAB_6D_3D", "HALL_LAB_6D_3D_2"]


@pytest.mark.parametrize(
    ("before", "after_s", "is_named"),
    [
        ("running", 1000.0, True),
        ("being saved", 100.0, True),
        ("stopped", 60.0, True),
        ("stopped", 60.1, False),
        ("saved", 60.0, True),
        ("saved", 60.1, False),
    ],
)
async def test_a_c3d_file_gets_the_name_of_its_take(
    tmp_path: Path, before: str, after_s: float, is_named: bool
) -> None:
    """It arrives some seconds after the take has ended; later, it belongs to something else."""
    file = tmp_path / "lab-1.c3d"
    file.write_bytes(b"c3d")
    clock = Clock()
    async with still_lab(tmp_path / "takes", clock, keep_last_s=60) as lab:
        lab.output.announce_file("lab", ServerFile(file, 3))  # before any take
        lab.publish()
        match before:
            case "running" | "stopped":
                await lab.takes.start("walk")
            case "being saved":
                await lab.takes.save(10, 600, "earlier")
                await lab.takes.save(10, 600, "walk")
            case _:
                await lab.takes.save(10, 0, "walk")
        if before == "stopped":
            await lab.takes.stop()
        clock.now_s += after_s
        lab.output.announce_file("lab", ServerFile(file, 3))
        found = [path for path in lab.path("").iterdir() if path.suffix == ".c3d"]
        assert [path.name for path in found] == ["walk.c3d"] * is_named
        assert all(path.samefile(file) for path in found)


async def test_withdrawing_a_source_ends_its_take(tmp_path: Path) -> None:
    """A source of the same name that is added later has nothing to do with it."""
    async with still_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        published = [lab.publish()]
        lab.output.withdraw("lab")
        await refused("no source 'lab'", lab.output.takes, "lab")
        lab.output.announce("lab")
        await lab.takes.start("run")
    assert frames(lab.path("walk.lcmlog")) == published


# Saving --------------------------------------------------------------------------------------


def test_a_saved_take_goes_on_from_the_command_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time that the disk needs is part of the seconds, not added to them."""

    async def save() -> None:
        clock = Clock()
        slow = RollingSegments.save

        def save_slowly(*arguments: Any, **options: Any) -> Save:
            clock.now_s += 2.0
            return slow(*arguments, **options)

        monkeypatch.setattr(RollingSegments, "save", save_slowly)
        async with still_lab(tmp_path, clock, keep_last_s=60) as lab:
            published = [lab.publish()]
            saved = await lab.takes.save(60, 5, "fall")
            assert saved.is_running
            published.append(lab.publish())
            await asyncio.sleep(2.9)
            assert [take.is_running for take in (await lab.takes.list()).takes] == [True]
            await asyncio.sleep(0.2)
            lab.publish()
            assert [take.is_running for take in (await lab.takes.list()).takes] == [False]
            await lab.output.storage.written()
            assert frames(lab.path("fall")) == published

    run_in_virtual_time(save())


def test_a_save_that_was_ended_does_not_end_again(tmp_path: Path) -> None:
    """Its timer would claim a C3D file that arrives long after the take."""
    file = tmp_path / "lab-1.c3d"
    file.write_bytes(b"c3d")

    async def save_and_end() -> None:
        async with still_lab(tmp_path, asyncio.get_running_loop().time, keep_last_s=60) as lab:
            lab.publish()
            await lab.takes.save(60, 30, "fall")
            lab.takes.end_takes()
            assert not lab.takes.saves
            for wait_s in (59, 2):
                await asyncio.sleep(wait_s)
                lab.output.announce_file("lab", ServerFile(file, 3))
            assert [path.name for path in lab.path("").glob("*.c3d")] == ["fall.c3d"]

    run_in_virtual_time(save_and_end())


async def test_the_seconds_that_are_saved_are_counted_from_the_command_on(tmp_path: Path) -> None:
    """A peer asks for what is just over, by the clock of this computer."""
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=60) as lab:
        published = []
        for _ in range(30):
            published.append(lab.publish())
            await lab.output.storage.written()
            clock.now_s += 1
        assert (await lab.takes.list()).kept_s == 30.0
        await lab.takes.save(1, 0, "some")
        await lab.takes.save(math.inf, 0, "all")
        lab.publish()
        await lab.output.storage.written()
        assert frames(lab.path("some")) == published[20:]
        assert frames(lab.path("all")) == published


async def test_takes_can_be_saved_beside_a_running_one_up_to_a_limit(tmp_path: Path) -> None:
    """Each has its own part of what is published; more than the limit would link every segment too often."""
    async with still_lab(tmp_path, keep_last_s=60) as lab:
        published = [lab.publish()]
        await lab.takes.start("walk")
        for number in range(MAX_SAVES):
            published.append(lab.publish())
            await lab.takes.save(60, 30, f"fall {number}")
        assert await refused("already", lab.takes.save, 30, 60) == "refused"
        await lab.takes.save(30, 0, "at once")
    assert frames(lab.path("walk.lcmlog")) == published[1:]
    assert all(frames(lab.path(f"fall {number}")) == published for number in range(MAX_SAVES))


async def test_saving_needs_something_that_is_kept(tmp_path: Path) -> None:
    """The peer learns whether to change the configuration, to wait, or to ask otherwise."""
    async with still_lab(tmp_path / "off") as lab:
        lab.publish()
        assert await refused("keep_last_s is 0", lab.takes.save, 60) == "nothing-yet"
    async with still_lab(tmp_path, keep_last_s=10) as lab:
        lab.publish()
        for last_s, after_s in ((0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0), (1.0, -1.0), (1.0, 3600.1)):
            await refused("expected last above 0", lab.takes.save, last_s, after_s)
        await lab.takes.save(0.1, 3600, "fall")
        await refused("there is a take 'fall'", lab.takes.start, "fall")


async def test_a_publisher_that_closes_frees_its_channel(tmp_path: Path) -> None:
    """A tool whose label comes back continues on the channel that it had."""
    async with still_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        for _ in range(2):
            pose = lab.output.publisher(Topic("lab", ("6d", "probe"), "rtc3d.tool_pose_t"))
            pose.publish(bytes(16))
            pose.close()
    assert [event.channel for event in events(lab.path("walk.lcmlog"))[1:]] == ["MOCAP_LAB_6D_PROBE"] * 2


async def test_the_list_counts_what_the_running_take_has_lost(tmp_path: Path) -> None:
    """Who sees it at once can repeat the trial; the file says it only when it has ended."""
    async with still_lab(tmp_path, max_queued_bytes=1000) as lab:
        await lab.takes.start("walk")
        for _ in range(20):
            with contextlib.suppress(OutputError):
                lab.publish()
        num_lost = [take.num_lost for take in (await lab.takes.list()).takes]
        running = (await lab.takes.list()).running
    assert running is not None
    assert num_lost == [running.num_lost]
    assert running.num_lost > 0


async def test_whoever_publishes_learns_when_messages_are_wanted(tmp_path: Path) -> None:
    """Only then are frames encoded for this output."""
    async with still_lab(tmp_path) as lab:
        seen: list[bool] = []
        lab.output.watch_wanted("lab", lambda: seen.append(lab.publishers["3d"].wanted))
        await lab.takes.start("walk")
        await lab.takes.stop()
        assert seen == [True, False]


async def test_the_end_of_the_gateway_forgets_the_timers_of_saves(tmp_path: Path) -> None:
    """They would fire while the output closes in another thread."""
    async with still_lab(tmp_path, keep_last_s=60) as lab:
        lab.publish()
        await lab.takes.save(60, 600, "fall")
        [timer] = lab.takes.saves.values()
        await lab.output.stop_queries()
        assert timer.cancelled()
