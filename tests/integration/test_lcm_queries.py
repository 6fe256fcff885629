"""Questions over LCM's multicast: requests, replies, and what strangers send."""

import struct
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from typing import Any, NamedTuple

import pytest
import rtc3d

from gateway.gateway import Gateway
from gateway.messages.decode import decode
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.queries import MAX_PENDING, MAX_REQUEST_BYTES, MAX_REQUESTER_BYTES, LcmQueries
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_port, lcm_url
from tests.querying import LabServer, gateway_at, is_filled, queries_of
from tests.servers import ScriptedServer
from tests.spec_parameters import in_root, spec_xml
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns
REQUEST, REPLY = "MOCAP_LAB_PARAMETERS_REQUEST", "MOCAP_LAB_PARAMETERS_REPLY"


class Peer:
    """A program on LCM that asks, and hears all replies and statuses."""

    def __init__(self, url: str, queries_url: str | None = None) -> None:
        self._lcm = open_lcm(queries_url or lcm_queries_url(url))
        self.replies: list[rtc3d.parameters_reply_t] = []
        self.statuses: list[rtc3d.status_t] = []
        self._listeners = [
            LcmSubscriber(self._lcm, REPLY, self._take),
            LcmSubscriber(open_lcm(url), "MOCAP_LAB_STATUS", self._take),
        ]

    def _take(self, channel: str, data: bytes) -> None:
        heard: list[Any] = self.replies if channel == REPLY else self.statuses
        heard.append(decode(data))

    def send(self, data: bytes) -> None:
        self._lcm.publish(REQUEST, data)

    async def ask(self, number: int = 1, sections: Sequence[str] = (), *, fresh: bool = False) -> Any:
        """Send one request and return the reply to it."""
        self.send(request(number, sections, fresh=fresh))
        await wait_until_async(lambda: self.answers(number))
        [reply] = self.answers(number)
        return reply

    def answers(self, number: int) -> list[rtc3d.parameters_reply_t]:
        return [reply for reply in self.replies if reply.request_id == number]

    def ignored(self, cause: str) -> int:
        """Return how many requests the newest status says were ignored for this cause."""
        if not self.statuses:
            return 0
        [output] = self.statuses[-1].outputs
        return sum(count.count for count in output.drops if count.name == cause)

    def close(self) -> None:
        for listener in self._listeners:
            listener.close()


def request(
    number: int, sections: Sequence[str] = (), *, fresh: bool = False, requester: str = "test"
) -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = number, requester, fresh
    message.sections, message.num_sections = list(sections), len(sections)
    encoded: bytes = message.encode()
    return encoded


class Lab(NamedTuple):
    server: LabServer
    gateway: Gateway
    peer: Peer


@asynccontextmanager
async def lab(server: LabServer | None = None, **settings: Any) -> AsyncIterator[Lab]:
    server, url = server or LabServer(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        gateway_at(listening.port, lcm_url=url, **settings) as gateway,
    ):
        await is_filled(gateway, server)
        peer = Peer(url)
        try:
            yield Lab(server, gateway, peer)
        finally:
            peer.close()


async def test_a_reply_has_the_requests_id_and_requester_the_xml_and_its_age() -> None:
    async with lab() as (server, _, peer):
        peer.send(request(-(2**63), requester="Fluß, 2. Stock"))
        await wait_until_async(lambda: peer.replies)
        [reply] = peer.replies
        assert (reply.request_id, reply.requester) == (-(2**63), "Fluß, 2. Stock")
        assert reply.xml.encode() == server.xml
        assert 0 <= reply.age_s < 60
        assert (reply.error, reply.error_code) == ("", "")


async def test_requests_may_come_on_a_url_of_their_own() -> None:
    data_url, queries_url = lcm_url(), lcm_url()
    server = LabServer()
    async with (
        ScriptedServer(server.script) as listening,
        gateway_at(listening.port, lcm_url=data_url, queries_url=queries_url) as gateway,
    ):
        await is_filled(gateway, server)
        elsewhere, peer = Peer(data_url, data_url), Peer(data_url, queries_url)
        try:
            elsewhere.send(request(1))  # nobody is there
            assert (await peer.ask(2)).xml.encode() == server.xml
            assert not peer.answers(1)
            assert not elsewhere.replies
        finally:
            elsewhere.close()
            peer.close()


async def test_a_url_for_requests_that_does_not_open_stops_nothing_else(
    caplog: pytest.LogCaptureFixture,
) -> None:
    data_url, nobody = lcm_url(), f"tcpq://127.0.0.1:{free_port()}"
    async with (
        ScriptedServer(LabServer().script) as listening,
        gateway_at(listening.port, lcm_url=data_url, queries_url=nobody),
    ):
        viewer = Peer(data_url)
        try:
            await wait_until_async(lambda: viewer.statuses)
        finally:
            viewer.close()
    assert f"lcm: no requests can be received: LCM does not open {nobody}" in caplog.text


@pytest.mark.parametrize("section", SECTIONS)
async def test_each_section_comes_verbatim(section: str) -> None:
    async with lab() as (_, _, peer):
        assert (await peer.ask(1, [section])).xml.encode() == spec_xml(section)


async def test_several_sections_are_asked_for_at_once() -> None:
    server = LabServer()
    server.sections["3d force"] = both = in_root("<The_3D/>", "<Force/>")
    async with lab(server) as (_, _, peer):
        assert (await peer.ask(1, ["force", "3d", "3d"])).xml.encode() == both
        assert server.commands[-1] == "SendParameters 3D Force"
        asked = server.count("SendParameters")
        assert (await peer.ask(2, list(SECTIONS))).xml.encode() == server.xml  # all there are is all
        assert (await peer.ask(3, ["3d", "force"])).xml.encode() == both
        assert server.count("SendParameters") == asked


async def test_fresh_parameters_are_the_servers_of_now() -> None:
    async with lab() as (server, _, peer):
        server.sections["3d"] = b"<RT_Parameters><The_3D/></RT_Parameters>"
        assert (await peer.ask(1, ["3d"])).xml.encode() == spec_xml("3d")
        assert (await peer.ask(2, ["3d"], fresh=True)).xml == "<RT_Parameters><The_3D/></RT_Parameters>"


async def test_xml_that_is_not_utf8_and_ends_in_nuls_becomes_text() -> None:
    server = LabServer()
    server.sections["3d"] = (
        "<RT_Parameters><The_3D><Unit>µm</Unit></The_3D></RT_Parameters>".encode("latin-1") + b"\0"
    )
    async with lab(server) as (_, _, peer):
        reply = await peer.ask(1, ["3d"])
        assert reply.xml == "<RT_Parameters><The_3D><Unit>µm</Unit></The_3D></RT_Parameters>"


async def test_an_unknown_section_is_answered_with_those_there_are() -> None:
    async with lab() as (_, _, peer):
        reply = await peer.ask(1, ["3d", "Markers\x1b[31m"])
        assert reply.error_code == "bad-request"
        assert reply.error == (
            r"unknown section 'Markers\x1b[31m'; accepted: general, 3d, 6d, analog, force, events"
        )
        assert (reply.xml, reply.age_s) == ("", 0)


async def test_without_a_server_the_reason_is_told_and_since_when() -> None:
    url, port = lcm_url(), free_port()
    async with gateway_at(port, lcm_url=url) as gateway:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.last_error)
        peer = Peer(url)
        try:
            reply = await peer.ask()
            assert reply.error_code == "no-connection"
            assert reply.error.startswith(
                f"source 'lab' has no connection: refused by 127.0.0.1:{port}, tried "
            )
        finally:
            peer.close()


@pytest.mark.parametrize(
    ("attribute", "code", "text"),
    [
        ("refused", "refused", "the server does not know SendParameters, or refuses it: err-unknown command"),
        ("silent", "timeout", "did not answer SendParameters within 0.3 s"),
    ],
)
async def test_what_a_server_does_not_give_is_told(attribute: str, code: str, text: str) -> None:
    async with lab(reply_timeout_s=0.3) as (server, _, peer):
        setattr(server, attribute, ("SendParameters",))
        reply = await peer.ask(fresh=True)
        assert reply.error_code == code
        assert text in reply.error


async def test_malformed_requests_are_counted_and_ignored() -> None:
    good = request(1)
    fingerprint, rest = good[:8], good[8:]
    malformed = [
        b"",
        b"\0",
        fingerprint,
        good[:-1],
        bytes(8) + rest,
        fingerprint + struct.pack(">qI", 2, 0xFFFFFFFF),  # a requester of 4 GB
        request(3, requester="x" * (MAX_REQUESTER_BYTES + 1)),
        request(4, ["general"] * 1000),
        request(5) + bytes(MAX_REQUEST_BYTES),
        request(6)[:-5] + struct.pack(">i", 2**31 - 1) + b"\1",  # two thousand million sections
    ]
    async with lab() as (_, gateway, peer):
        for data in malformed:
            peer.send(data)
        assert (await peer.ask(7)).error == ""
        await wait_until_async(lambda: peer.ignored("malformed request") == len(malformed))
        assert [reply.request_id for reply in peer.replies] == [7]
        queries = queries_of(gateway)
        assert queries.results == {"ok": 1}


async def test_the_queue_is_bounded_and_what_is_beyond_it_is_counted() -> None:
    async with lab(reply_timeout_s=20.0, query_timeout_s=20.0) as (server, gateway, peer):
        queries = queries_of(gateway)

        def waiting(count: int) -> bool:
            return len(queries._tasks) == count

        server.open.clear()
        for number in range(MAX_PENDING):
            peer.send(request(number, fresh=True))
            # LCM's own queue is bounded too: no faster than the gateway takes them out of it.
            await wait_until_async(partial(waiting, number + 1))
        peer.send(request(1000))
        peer.send(request(1001))
        await wait_until_async(lambda: peer.ignored("request beyond the queue") == 2)
        before = server.count("SendParameters")
        server.open.set()
        await wait_until_async(lambda: len(peer.replies) == MAX_PENDING)
        assert {reply.error for reply in peer.replies} == {""}
        assert server.count("SendParameters") == before

        def answered() -> object:
            peer.send(request(2000))  # again and again: so many replies at once can cost LCM a message
            return peer.answers(2000)

        await wait_until_async(answered)
        assert peer.answers(2000)[0].error == ""
        assert not peer.answers(1000)


async def test_who_has_a_reply_may_ask_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.outputs.lcm.queries.MAX_PENDING", 1)
    async with lab() as (_, gateway, peer):
        queries = queries_of(gateway)
        assert isinstance(queries, LcmQueries)
        publish, free, could_ask = queries._publish, queries._free, []

        def publish_and_look(connection: Any, source: str, name: str, message: Any) -> None:
            publish(connection, source, name, message)
            if name == "PARAMETERS_REPLY":
                could_ask.append(free.acquire(blocking=False))
                free.release()

        monkeypatch.setattr(queries, "_publish", publish_and_look)
        assert (await peer.ask(1)).error == ""
        assert could_ask == [True]


async def test_replies_of_others_are_no_requests() -> None:
    async with lab() as (_, _, peer):
        reply = rtc3d.parameters_reply_t()
        peer.send(reply.encode())
        await wait_until_async(lambda: peer.ignored("malformed request") == 1)
        assert peer.replies == []


async def test_two_who_ask_with_the_same_number_are_told_apart() -> None:
    async with lab() as (_, _, peer):
        peer.send(request(1, requester="one"))
        peer.send(request(1, requester="two"))
        await wait_until_async(lambda: len(peer.replies) == 2)
        assert sorted(reply.requester for reply in peer.replies) == ["one", "two"]


async def test_requests_under_way_end_with_the_gateway() -> None:
    async with lab(reply_timeout_s=20.0, query_timeout_s=20.0) as (server, gateway, peer):
        server.silent = ("SendParameters",)
        peer.send(request(1, fresh=True))
        queries = queries_of(gateway)
        await wait_until_async(lambda: queries._tasks)
    assert queries._tasks == set()
    assert peer.replies == []
