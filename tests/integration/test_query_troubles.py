"""What goes wrong around questions and files, and that the gateway says so and goes on."""

import asyncio
import logging
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest
import zenoh

from gateway.c3d_spool import Spool
from gateway.errors import QueryError
from gateway.outputs.contract import Answer, KeyPath
from gateway.outputs.zenoh import queries as zenoh_queries
from gateway.outputs.zenoh.queries import ZenohQueries
from gateway.queries.service import SourceQueryService
from gateway.queries.source_queries import SourceQueries
from tests.networks import free_endpoint, open_zenoh
from tests.querying import ask, asker_at, gateway_at, lab, queries_of
from tests.servers import packet
from tests.waiting import wait_until_async


async def test_a_defect_is_told_to_the_asker_and_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_desk: SourceQueries, _question: object) -> None:
        raise ZeroDivisionError("of all things")

    async with lab() as (server, _, _, asker):
        monkeypatch.setattr(SourceQueries, "_recording", fail)
        reply = await ask(asker, "mocap/lab/recording")
        assert reply.code == "defect"
        assert "ZeroDivisionError('of all things')" in reply.error
        assert "ZeroDivisionError" in caplog.text
        assert (await ask(asker, "mocap/lab/parameters")).payload == server.xml


async def test_questions_beyond_the_limit_are_told_to_come_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_queries, "MAX_PENDING", 2)
    async with lab() as (server, _, gateway, asker):
        queries = queries_of(gateway)
        server.open.clear()
        waiting = [asyncio.create_task(ask(asker, "mocap/lab/parameters?fresh=true")) for _ in range(2)]
        await wait_until_async(lambda: len(queries._tasks) == 2)
        reply = await ask(asker, "mocap/lab/status")
        assert (reply.code, reply.error) == ("busy", "the gateway has too many queries; try again")
        server.open.set()
        assert {reply.payload for reply in await asyncio.gather(*waiting)} == {server.xml}
        assert (await ask(asker, "mocap/lab/status")).payload
        # A reply can arrive before it is counted.
        await wait_until_async(lambda: queries.results == {"busy": 1, "ok": 3})


async def test_askers_see_at_once_that_the_gateway_ends() -> None:
    endpoint = free_endpoint()
    router = open_zenoh("router", listen=endpoint)
    service = SilentService()
    queries = ZenohQueries("mocap", service, asyncio.get_running_loop())
    session = open_zenoh("client", connect=endpoint)
    try:
        queries.open(session, ["lab"])
        with asker_at(endpoint) as asker:
            ended = asyncio.Event()
            loop = asyncio.get_running_loop()
            replies: list[zenoh.Reply] = []
            end = zenoh.handlers.Callback(replies.append, drop=lambda: loop.call_soon_threadsafe(ended.set))
            asker.get("mocap/lab/status", end, timeout=60)
            await service.asked.wait()
            await queries.close()
            async with asyncio.timeout(10):
                await ended.wait()
            assert replies == []
    finally:
        session.close()
        router.close()


async def test_without_time_stamps_late_subscribers_must_ask_and_the_log_says_how_to_change_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)  # Zenoh's own default: no time stamps
    heard: list[bytes] = []
    try:
        queries = ZenohQueries("mocap", SilentService(), asyncio.get_running_loop())
        queries.open(session, ["lab"])
        assert "set timestamping: {enabled: true} in Zenoh's configuration file" in caplog.text
        with asker_at(endpoint) as asker:
            asker.declare_subscriber(
                "mocap/lab/parameters", lambda sample: heard.append(sample.payload.to_bytes())
            )
            queries.publish_parameters("lab", b"<RT_Parameters/>")
            await wait_until_async(lambda: heard)
        await queries.close()
    finally:
        session.close()
    assert set(heard) == {b"<RT_Parameters/>"}


class SilentService(SourceQueryService):
    """Has the source "lab", and never answers."""

    def __init__(self) -> None:
        self.asked = asyncio.Event()

    def serves(self, source: str) -> bool:
        return source == "lab"

    async def answer(self, _source: str, _path: KeyPath, _options: Mapping[str, str]) -> Answer:
        self.asked.set()
        never: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        return await never


async def test_parameters_published_after_zenoh_has_closed_do_no_harm() -> None:
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)
    queries = ZenohQueries("mocap", SilentService(), asyncio.get_running_loop())
    queries.open(session, ["lab"])
    session.close()
    queries.publish_parameters("lab", b"<RT_Parameters/>")
    queries.announce_file("lab", {"name": "a.c3d"})
    await queries.close()
    queries.publish_parameters("lab", b"<RT_Parameters/>")


async def test_a_file_that_cannot_be_kept_is_logged_and_the_stream_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "spool").write_text("a file where the folder should be")
    async with lab(spool=tmp_path / "spool") as (server, _, _, asker):
        server.send(packet(5, b"content"))
        await wait_until_async(lambda: "cannot be kept in" in caplog.text)
        assert (await ask(asker, "mocap/lab/c3d")).code == "nothing-yet"
        assert (await ask(asker, "mocap/lab/parameters?fresh=true")).payload == server.xml
    assert any(record.levelno == logging.ERROR for record in caplog.records)


async def test_files_that_come_faster_than_the_disk_takes_them_are_dropped_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk, store = threading.Event(), Spool.store

    def slow(spool: Spool, source: str, content: bytes) -> Path:
        disk.wait(20)
        return store(spool, source, content)

    monkeypatch.setattr(Spool, "store", slow)
    try:
        async with lab(spool=tmp_path) as (server, _, _, _):
            for number in range(6):
                server.send(packet(5, b"content %d" % number))
            await wait_until_async(lambda: caplog.text.count("4 earlier files are still being written") == 2)
            disk.set()
            await wait_until_async(lambda: len(list(tmp_path.glob("*.c3d"))) == 4)
            server.send(packet(5, b"a later one"))
            await wait_until_async(lambda: len(list(tmp_path.glob("*.c3d"))) == 5)
    finally:
        disk.set()


async def test_a_deleted_file_is_not_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with lab(spool=tmp_path) as (_, _, gateway, _):
        [source] = gateway.sources
        monkeypatch.setattr(Spool, "newest", lambda _spool, _source: tmp_path / "gone.c3d")
        with pytest.raises(QueryError, match=r"gone\.c3d cannot be read: No such file or directory"):
            await source._last_c3d()


async def test_a_gateway_whose_zenoh_is_not_open_yet_starts_and_ends() -> None:
    async with gateway_at(1, router=free_endpoint()) as gateway:
        queries = queries_of(gateway)
        queries.publish_parameters("lab", b"<RT_Parameters/>")
        assert gateway.sources
