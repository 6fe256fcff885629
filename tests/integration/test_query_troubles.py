"""Failures around queries and files: the gateway reports them and continues."""

import asyncio
import logging
import os
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest
import zenoh

from gateway.outputs.contract import Answer, KeyPath, ServerParameters
from gateway.outputs.zenoh import queries as zenoh_queries
from gateway.outputs.zenoh.queries import ZenohQueries
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.queries.service import SourceQueryService
from gateway.queries.source_queries import SourceQueries
from tests.losses import amounts
from tests.networks import free_endpoint, open_zenoh
from tests.queried_gateway import gateway_with_server, output_queries, query, run_gateway, zenoh_peer
from tests.servers import c3d_file, packet
from tests.waiting import wait_until_async


async def test_a_defect_is_logged_and_reported_to_the_peer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_queries: SourceQueries, _question: object) -> None:
        raise ZeroDivisionError("a defect")

    async with gateway_with_server() as (server, _, _, peer):
        monkeypatch.setattr(SourceQueries, "_recording", fail)
        reply = await query(peer, "mocap/lab/recording")
        assert reply.code == "defect"
        assert "ZeroDivisionError('a defect')" in reply.error
        assert "ZeroDivisionError" in caplog.text
        assert (await query(peer, "mocap/lab/parameters")).payload == server.xml


async def test_queries_beyond_the_limit_are_refused_as_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_queries, "MAX_PENDING", 2)
    async with gateway_with_server() as (server, _, gateway, peer):
        queries = output_queries(gateway)
        server.may_answer.clear()
        waiting = [asyncio.create_task(query(peer, "mocap/lab/parameters?fresh=true")) for _ in range(2)]
        await wait_until_async(lambda: queries._admission.num_pending == 2)
        reply = await query(peer, "mocap/lab/status")
        assert (reply.code, reply.error) == ("busy", "the gateway has too many queries; try again")
        server.may_answer.set()
        assert {reply.payload for reply in await asyncio.gather(*waiting)} == {server.xml}
        assert (await query(peer, "mocap/lab/status")).payload
        # A reply can arrive before it is counted.
        await wait_until_async(lambda: queries.results == {"lab": {"busy": 1, "ok": 3}})


async def test_queries_end_at_once_when_the_gateway_closes() -> None:
    endpoint = free_endpoint()
    router = open_zenoh("router", listen=endpoint)
    service = SilentService()
    queries = ZenohQueries(ZenohSettings(), service, asyncio.get_running_loop())
    session = open_zenoh("client", connect=endpoint)
    try:
        queries.open(session, ["lab"])
        with zenoh_peer(endpoint) as peer:
            ended = asyncio.Event()
            loop = asyncio.get_running_loop()
            replies: list[zenoh.Reply] = []
            end = zenoh.handlers.Callback(replies.append, drop=lambda: loop.call_soon_threadsafe(ended.set))
            peer.get("mocap/lab/status", end, timeout=60)
            await service.received_query.wait()
            await queries.close()
            async with asyncio.timeout(30):
                await ended.wait()
            assert replies == []
    finally:
        session.close()
        router.close()


async def test_without_time_stamps_the_log_says_how_to_enable_the_cache_for_late_subscribers(
    caplog: pytest.LogCaptureFixture,
) -> None:
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)  # without time stamps, the default of Zenoh
    received: list[bytes] = []
    try:
        queries = ZenohQueries(ZenohSettings(), SilentService(), asyncio.get_running_loop())
        queries.open(session, ["lab"])
        assert "set timestamping: {enabled: true} in Zenoh's configuration file" in caplog.text
        with zenoh_peer(endpoint) as peer:
            peer.declare_subscriber(
                "mocap/lab/parameters", lambda sample: received.append(sample.payload.to_bytes())
            )

            def publish_and_receive() -> object:
                queries.publish_parameters("lab", ServerParameters(b"<RT_Parameters/>", 3, 2))
                return received  # nothing before the session knows of the subscriber

            await wait_until_async(publish_and_receive)
        await queries.close()
    finally:
        session.close()
    assert set(received) == {b"<RT_Parameters/>"}


class SilentService(SourceQueryService):
    """Serves the source "lab" and never answers."""

    def __init__(self) -> None:
        self.received_query = asyncio.Event()

    def serves(self, source: str) -> bool:
        return source == "lab"

    async def answer(self, _source: str, _path: KeyPath, _options: Mapping[str, str]) -> Answer:
        self.received_query.set()
        never: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        return await never


async def test_publishing_parameters_after_zenoh_has_closed_is_ignored() -> None:
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)
    queries = ZenohQueries(ZenohSettings(), SilentService(), asyncio.get_running_loop())
    queries.open(session, ["lab"])
    session.close()
    queries.publish_parameters("lab", ServerParameters(b"<RT_Parameters/>", 3, 2))
    queries.announce_file("lab", {"name": "a.c3d"})
    await queries.close()
    queries.publish_parameters("lab", ServerParameters(b"<RT_Parameters/>", 3, 2))


async def test_a_file_that_cannot_be_stored_is_logged_and_the_stream_continues(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "spool").write_text("a file in place of the folder")
    async with gateway_with_server(spool=tmp_path / "spool") as (server, _, _, peer):
        server.send(packet(5, c3d_file()))
        await wait_until_async(lambda: "cannot be stored in" in caplog.text)
        assert (await query(peer, "mocap/lab/c3d")).code == "nothing-yet"
        assert (await query(peer, "mocap/lab/parameters?fresh=true")).payload == server.xml
    assert any(record.levelno == logging.ERROR for record in caplog.records)


async def test_files_that_arrive_faster_than_the_disk_writes_are_dropped_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _descriptor: disk.wait(60))  # the real disk may be busy
    try:
        async with gateway_with_server(spool=tmp_path) as (server, _, gateway, peer):
            for number in range(6):
                server.send(packet(5, c3d_file(b"content %d" % number)))
            [status] = gateway.sources[0].statuses
            await wait_until_async(lambda: amounts(status.losses.report()) == {"C3D file": (2, 0)})
            assert caplog.text.count("4 earlier files are still being written") == 1
            disk.set()
            while (await query(peer, "mocap/lab/c3d")).payload != c3d_file(b"content 3"):
                pass  # the disk has a file before the gateway knows that it is stored
            server.send(packet(5, c3d_file(b"a later one")))
            await wait_until_async(lambda: len(list(tmp_path.glob("*.c3d"))) == 5)
    finally:
        disk.set()


async def test_a_gateway_runs_and_stops_while_zenoh_is_not_open() -> None:
    async with run_gateway(1, router=free_endpoint()) as gateway:
        queries = output_queries(gateway)
        queries.publish_parameters("lab", ServerParameters(b"<RT_Parameters/>", 3, 2))
        assert gateway.sources
