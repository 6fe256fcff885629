"""Parameter requests over LCM multicast: replies, errors and malformed requests."""

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
from gateway.outputs.lcm.queries import LcmQueries
from gateway.outputs.lcm.requests import MAX_PENDING, MAX_REQUEST_BYTES, MAX_REQUESTER_BYTES
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_port, lcm_url
from tests.queried_gateway import (
    ParameterServer,
    ServerOfSections,
    output_queries,
    run_gateway,
    wait_until_cached,
)
from tests.servers import ScriptedServer
from tests.spec_parameters import in_root, spec_xml
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns
REQUEST, REPLY = "MOCAP_LAB_PARAMETERS_REQUEST", "MOCAP_LAB_PARAMETERS_REPLY"


class LcmPeer:
    """A program on LCM that sends requests and receives all replies and status messages."""

    def __init__(self, url: str, queries_url: str | None = None) -> None:
        self._lcm = open_lcm(queries_url or lcm_queries_url(url))
        self.replies: list[rtc3d.parameters_reply_t] = []
        self.statuses: list[rtc3d.status_t] = []
        self._subscribers = [
            LcmSubscriber(self._lcm, REPLY, self._append),
            LcmSubscriber(open_lcm(url), "MOCAP_LAB_STATUS", self._append),
        ]

    def _append(self, channel: str, data: bytes) -> None:
        messages: list[Any] = self.replies if channel == REPLY else self.statuses
        messages.append(decode(data))

    def send(self, data: bytes) -> None:
        self._lcm.publish(REQUEST, data)

    async def request(self, number: int = 1, sections: Sequence[str] = (), *, fresh: bool = False) -> Any:
        """Send a request and return its reply."""
        self.send(encode_request(number, sections, fresh=fresh))
        await wait_until_async(lambda: self.answers(number))
        [reply] = self.answers(number)
        return reply

    def answers(self, number: int) -> list[rtc3d.parameters_reply_t]:
        return [reply for reply in self.replies if reply.request_id == number]

    def ignored(self, cause: str) -> int:
        """Return how many requests were ignored for this cause, from the newest status."""
        if not self.statuses:
            return 0
        [output] = self.statuses[-1].outputs
        return sum(loss.messages for loss in output.drops if loss.cause == cause)

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.close()


def encode_request(
    number: int, sections: Sequence[str] = (), *, fresh: bool = False, requester: str = "test"
) -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = number, requester, fresh
    message.sections, message.num_sections = list(sections), len(sections)
    encoded: bytes = message.encode()
    return encoded


class LcmSetup(NamedTuple):
    server: ParameterServer
    gateway: Gateway
    peer: LcmPeer


@asynccontextmanager
async def gateway_with_lcm_peer(
    server: ParameterServer | None = None, **settings: Any
) -> AsyncIterator[LcmSetup]:
    server, url = server or ParameterServer(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, lcm_url=url, **settings) as gateway,
    ):
        await wait_until_cached(gateway)
        peer = LcmPeer(url)
        try:
            yield LcmSetup(server, gateway, peer)
        finally:
            peer.close()


async def test_a_reply_has_id_and_requester_of_the_request_and_the_xml_with_its_age() -> None:
    async with gateway_with_lcm_peer() as (server, _, peer):
        peer.send(encode_request(-(2**63), requester="Käfig, 2"))
        await wait_until_async(lambda: peer.replies)
        [reply] = peer.replies
        assert (reply.request_id, reply.requester) == (-(2**63), "Käfig, 2")
        assert reply.xml.encode() == server.xml
        assert 0 <= reply.age_s < 60
        assert (reply.error, reply.error_code) == ("", "")


async def test_requests_can_use_a_separate_url() -> None:
    data_url, queries_url = lcm_url(), lcm_url()
    server = ParameterServer()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, lcm_url=data_url, queries_url=queries_url) as gateway,
    ):
        await wait_until_cached(gateway)
        wrong_url_peer, peer = LcmPeer(data_url, data_url), LcmPeer(data_url, queries_url)
        try:
            wrong_url_peer.send(encode_request(1))  # on the URL for data
            assert (await peer.request(2)).xml.encode() == server.xml
            assert not peer.answers(1)
            assert not wrong_url_peer.replies
        finally:
            wrong_url_peer.close()
            peer.close()


async def test_a_queries_url_that_does_not_open_does_not_stop_the_output(
    caplog: pytest.LogCaptureFixture,
) -> None:
    data_url, closed_url = lcm_url(), f"tcpq://127.0.0.1:{free_port()}"
    async with (
        ScriptedServer(ParameterServer().script) as listening,
        run_gateway(listening.port, lcm_url=data_url, queries_url=closed_url),
    ):
        viewer = LcmPeer(data_url)
        try:
            await wait_until_async(lambda: viewer.statuses)
        finally:
            viewer.close()
    assert f"lcm: no requests can be received: LCM does not open {closed_url}" in caplog.text


@pytest.mark.parametrize("section", SECTIONS)
async def test_each_section_is_answered_unchanged(section: str) -> None:
    async with gateway_with_lcm_peer(ServerOfSections()) as (_, _, peer):
        assert (await peer.request(1, [section])).xml.encode() == spec_xml(section)


async def test_several_sections_are_requested_with_one_command() -> None:
    server = ServerOfSections()
    server.sections["3d force"] = both = in_root("<The_3D/>", "<Force/>")
    async with gateway_with_lcm_peer(server) as (_, _, peer):
        assert (await peer.request(1, ["force", "3d", "3d"])).xml.encode() == both
        assert server.commands[-1] == "SendParameters 3D Force"
        num_requests = server.count("SendParameters")
        # A request for all sections is one for all parameters.
        assert (await peer.request(2, list(SECTIONS))).xml.encode() == server.xml
        assert (await peer.request(3, ["3d", "force"])).xml.encode() == both
        assert server.count("SendParameters") == num_requests


async def test_fresh_parameters_are_requested_from_the_server() -> None:
    async with gateway_with_lcm_peer() as (server, _, peer):
        server.xml = b"<RT_Parameters><The_3D/></RT_Parameters>"
        assert "Marker 1" in (await peer.request(1, ["3d"])).xml
        assert (await peer.request(2, ["3d"], fresh=True)).xml == "<RT_Parameters><The_3D/></RT_Parameters>"


async def test_xml_in_latin1_with_trailing_nuls_is_decoded() -> None:
    server = ServerOfSections()
    server.sections["3d"] = (
        "<RT_Parameters><The_3D><Unit>µm</Unit></The_3D></RT_Parameters>".encode("latin-1") + b"\0"
    )
    async with gateway_with_lcm_peer(server) as (_, _, peer):
        reply = await peer.request(1, ["3d"])
        assert reply.xml == "<RT_Parameters><The_3D><Unit>µm</Unit></The_3D></RT_Parameters>"


async def test_the_error_for_an_unknown_section_lists_the_known_ones() -> None:
    async with gateway_with_lcm_peer() as (_, _, peer):
        reply = await peer.request(1, ["3d", "Markers\x1b[31m"])
        assert reply.error_code == "bad-request"
        assert reply.error == (
            r"unknown section 'Markers\x1b[31m'; accepted: general, 3d, 6d, analog, force, events"
        )
        assert (reply.xml, reply.age_s) == ("", 0)


async def test_without_a_connection_the_error_has_the_reason_and_its_age() -> None:
    url, port = lcm_url(), free_port()
    async with run_gateway(port, lcm_url=url) as gateway:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.last_error)
        peer = LcmPeer(url)
        try:
            reply = await peer.request()
            assert reply.error_code == "no-connection"
            assert reply.error.startswith(
                f"source 'lab' has no connection: refused by 127.0.0.1:{port}, tried "
            )
        finally:
            peer.close()


@pytest.mark.parametrize(
    ("attribute", "code", "text"),
    [
        (
            "refused_commands",
            "refused",
            "the server does not know SendParameters, or refuses it: err-unknown command",
        ),
        ("ignored_commands", "timeout", "did not answer SendParameters within 0.3 s"),
    ],
)
async def test_a_refusal_or_missing_reply_of_the_server_is_an_error(
    attribute: str, code: str, text: str
) -> None:
    async with gateway_with_lcm_peer(reply_timeout_s=0.3) as (server, _, peer):
        setattr(server, attribute, ("SendParameters",))
        reply = await peer.request(fresh=True)
        assert reply.error_code == code
        assert text in reply.error


async def test_malformed_requests_are_counted_and_ignored() -> None:
    good = encode_request(1)
    fingerprint, rest = good[:8], good[8:]
    malformed = [
        b"",
        b"\0",
        fingerprint,
        good[:-1],
        bytes(8) + rest,
        fingerprint + struct.pack(">qI", 2, 0xFFFFFFFF),  # a requester of 4 GB
        encode_request(3, requester="x" * (MAX_REQUESTER_BYTES + 1)),
        encode_request(4, ["general"] * 1000),
        encode_request(5) + bytes(MAX_REQUEST_BYTES),
        encode_request(6)[:-5] + struct.pack(">i", 2**31 - 1) + b"\1",  # 2³¹ - 1 sections
    ]
    async with gateway_with_lcm_peer() as (_, gateway, peer):
        for data in malformed:
            peer.send(data)
        assert (await peer.request(7)).error == ""
        await wait_until_async(lambda: peer.ignored("malformed request") == len(malformed))
        assert [reply.request_id for reply in peer.replies] == [7]
        queries = output_queries(gateway)
        assert queries.results == {"lab": {"ok": 1}}


async def test_requests_beyond_the_queue_are_dropped_and_counted() -> None:
    async with gateway_with_lcm_peer(reply_timeout_s=20.0, query_timeout_s=20.0) as (server, gateway, peer):
        queries = output_queries(gateway)

        def waiting(count: int) -> bool:
            return len(queries._requests._tasks) == count

        server.may_answer.clear()
        for number in range(MAX_PENDING):
            peer.send(encode_request(number, fresh=True))
            # Wait for each request, because the queue of LCM is bounded too.
            await wait_until_async(partial(waiting, number + 1))
        peer.send(encode_request(1000))
        peer.send(encode_request(1001))
        await wait_until_async(lambda: peer.ignored("request beyond the queue") == 2)
        before = server.count("SendParameters")
        server.may_answer.set()
        await wait_until_async(lambda: len(peer.replies) == MAX_PENDING)
        assert {reply.error for reply in peer.replies} == {""}
        assert server.count("SendParameters") == before

        def answered() -> object:
            # Send it repeatedly, because LCM can lose a message among so many replies.
            peer.send(encode_request(2000))
            return peer.answers(2000)

        await wait_until_async(answered)
        assert peer.answers(2000)[0].error == ""
        assert not peer.answers(1000)


async def test_a_requester_can_send_the_next_request_as_soon_as_it_has_a_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.outputs.lcm.requests.MAX_PENDING", 1)
    async with gateway_with_lcm_peer() as (_, gateway, peer):
        queries = output_queries(gateway)
        assert isinstance(queries, LcmQueries)
        requests, is_slot_free = queries._requests, []
        send = requests._send

        def send_and_check(channel: str, reply: bytes) -> None:
            send(channel, reply)
            is_slot_free.append(requests._admission.num_pending == 0)

        monkeypatch.setattr(requests, "_send", send_and_check)
        assert (await peer.request(1)).error == ""
        assert is_slot_free == [True]


async def test_a_reply_on_the_request_channel_is_a_malformed_request() -> None:
    async with gateway_with_lcm_peer() as (_, _, peer):
        reply = rtc3d.parameters_reply_t()
        peer.send(reply.encode())
        await wait_until_async(lambda: peer.ignored("malformed request") == 1)
        assert peer.replies == []


async def test_replies_to_requests_with_the_same_id_name_their_requester() -> None:
    async with gateway_with_lcm_peer() as (_, _, peer):
        peer.send(encode_request(1, requester="one"))
        peer.send(encode_request(1, requester="two"))
        await wait_until_async(lambda: len(peer.replies) == 2)
        assert sorted(reply.requester for reply in peer.replies) == ["one", "two"]


async def test_pending_requests_are_cancelled_when_the_gateway_stops() -> None:
    async with gateway_with_lcm_peer(reply_timeout_s=20.0, query_timeout_s=20.0) as (server, gateway, peer):
        server.ignored_commands = ("SendParameters",)
        peer.send(encode_request(1, fresh=True))
        queries = output_queries(gateway)
        await wait_until_async(lambda: queries._requests._tasks)
    assert queries._requests._tasks == set()
    assert peer.replies == []
