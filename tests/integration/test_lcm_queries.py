"""Requests for parameters over LCM multicast: replies and malformed requests."""

import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import pytest
import rtc3d

from gateway.gateway import Gateway
from gateway.outputs.lcm.requests import MAX_REQUEST_BYTES, MAX_REQUESTER_BYTES
from gateway.rtc3d.parameters import SECTIONS
from tests.integration.lcm_peer import LcmPeer, encode_request
from tests.networks import lcm_url
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


class LcmSetup(NamedTuple):
    server: ParameterServer
    gateway: Gateway
    peer: LcmPeer
    urls: tuple[str, str]


@asynccontextmanager
async def gateway_with_lcm_peer(
    server: ParameterServer | None = None, **settings: Any
) -> AsyncIterator[LcmSetup]:
    server, url, queries_url = server or ParameterServer(), lcm_url(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, lcm_url=url, queries_url=queries_url, **settings) as gateway,
    ):
        await wait_until_cached(gateway)
        peer = LcmPeer(url, queries_url)
        try:
            yield LcmSetup(server, gateway, peer, (url, queries_url))
        finally:
            peer.close()


async def test_on_lcm_parameters_are_the_servers_xml() -> None:
    server = ServerOfSections()
    server.sections["3d force"] = both = in_root("<The_3D/>", "<Force/>")
    async with gateway_with_lcm_peer(server) as (_, _, peer, urls):
        wrong_url_peer = LcmPeer(urls[0], urls[0])
        wrong_url_peer.send(encode_request(99))  # on the URL for data
        peer.send(encode_request(-(2**63), requester="Käfig, 2"))
        await wait_until_async(lambda: peer.replies)
        [reply] = peer.replies
        assert (reply.request_id, reply.requester) == (-(2**63), "Käfig, 2")
        assert (reply.xml.encode(), reply.error, reply.error_code) == (server.xml, "", "")
        assert 0 <= reply.age_s < 60
        for number, section in enumerate(SECTIONS):
            assert (await peer.request(number, [section])).xml.encode() == spec_xml(section)
        assert (await peer.request(10, ["force", "3d", "3d"])).xml.encode() == both
        assert server.commands[-1] == "SendParameters 3D Force"
        num_requests = server.count("SendParameters")
        assert (await peer.request(11, ["3d", "force"])).xml.encode() == both
        assert server.count("SendParameters") == num_requests
        assert not peer.answers(99)
        assert not wrong_url_peer.replies
        wrong_url_peer.close()


async def test_malformed_requests_on_lcm_are_counted_and_ignored() -> None:
    good = encode_request(1)
    fingerprint, rest = good[:8], good[8:]
    malformed = [
        *(b"", b"\0", fingerprint, good[:-1], bytes(8) + rest, rtc3d.parameters_reply_t().encode()),
        fingerprint + struct.pack(">qI", 2, 0xFFFFFFFF),  # a requester of 4 GB
        encode_request(3, requester="x" * (MAX_REQUESTER_BYTES + 1)),
        encode_request(4, ["general"] * 1000),
        encode_request(5) + bytes(MAX_REQUEST_BYTES),
        encode_request(6)[:-5] + struct.pack(">i", 2**31 - 1) + b"\1",  # 2³¹ - 1 sections
    ]
    async with gateway_with_lcm_peer() as (_, gateway, peer, _):
        for data in malformed:
            peer.send(data)
        reply = await peer.request(7, ["3d", "Markers\x1b[31m"])
        assert reply.error_code == "bad-request"
        assert reply.error == (
            r"unknown section 'Markers\x1b[31m'; accepted: general, 3d, 6d, analog, force, events"
        )
        await wait_until_async(lambda: peer.ignored("malformed request") == len(malformed))
        assert [reply.request_id for reply in peer.replies] == [7]
        assert output_queries(gateway).results == {"lab": {"bad-request": 1}}


async def test_a_requester_on_lcm_can_send_the_next_request_as_soon_as_it_has_a_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.outputs.lcm.requests.MAX_PENDING", 1)
    async with gateway_with_lcm_peer() as (_, gateway, peer, _):
        requests, is_slot_free = output_queries(gateway)._requests, []
        send = requests._send

        def send_and_check(channel: str, reply: bytes) -> None:
            send(channel, reply)
            is_slot_free.append(requests._admission.num_pending == 0)

        monkeypatch.setattr(requests, "_send", send_and_check)
        assert (await peer.request(1)).error == ""
        assert is_slot_free == [True]
