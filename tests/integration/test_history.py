"""Queries for messages that were published before, on Zenoh and LCM, to a whole gateway with its server."""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.config.settings import HistorySettings
from gateway.daemon.gateway import Gateway
from gateway.messages.decode import decode
from gateway.messages.history import WantedMessages, sequence_of, unpack_messages
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.outputs.takes.settings import TakesSettings
from gateway.rtc3d.components import ComponentType
from tests.support.errors import names
from tests.support.networks import lcm_url
from tests.support.queried_gateway import (
    ParameterServer,
    gateway_with_server,
    query,
    query_all,
    run_gateway,
    until_a_frame,
)
from tests.support.servers import ScriptedServer, markers_frame
from tests.support.waiting import wait_until_async


async def publish_frames(server: ParameterServer, gateway: Gateway, number: int) -> None:
    """Send frames until the gateway has numbered this many messages of markers."""
    await until_a_frame(gateway)
    for index in range(1, number):
        server.send(markers_frame(7 + index, (1.0, 2.0, float(index))))
    fan_out = gateway.sources[0].fan_out
    await wait_until_async(lambda: fan_out.frames[ComponentType.MARKERS] == number)


async def test_on_zenoh_a_subscriber_gets_the_very_messages_that_it_has_missed() -> None:
    server = ParameterServer()
    async with gateway_with_server(server) as (_, _, gateway, peer):
        received: list[bytes] = []
        subscriber = peer.declare_subscriber(
            "mocap/lab/3d", lambda sample: received.append(sample.payload.to_bytes())
        )
        await wait_until_async(lambda: gateway.sources[0].fan_out.has_subscribers([ComponentType.MARKERS]))
        await publish_frames(server, gateway, 10)
        await wait_until_async(lambda: received and sequence_of(received[-1]) == 9)
        subscriber.undeclare()
        reply = await query(peer, "mocap/lab/3d?from=3;to=5")
        facts = {"from": 3, "to": 5, "oldest": 0, "newest": 9, "num_messages": 3}
        assert (reply.attachment, reply.encoding) == (facts, "application/x-lcm-messages;rtc3d.markers_t")
        assert unpack_messages(reply.payload) == [each for each in received if 3 <= sequence_of(each) <= 5]
        everything = unpack_messages((await query(peer, "mocap/lab/3d?last_s=1000")).payload)
        assert [sequence_of(each) for each in everything] == list(range(10))
        assert everything[-len(received) :] == received
        [reply] = await query_all(peer, "mocap/*/3d?from=8&to=99")
        assert [sequence_of(each) for each in unpack_messages(reply.payload)] == [8, 9]
        overview = (await query(peer, "mocap/lab/history")).json
        assert overview["keys"]["3d"]["newest"] == 9
        assert 0 < overview["num_bytes"] <= overview["max_bytes"]
        assert overview["num_found"] == {"zenoh": 15}


@pytest.mark.netns
async def test_on_lcm_messages_are_sent_again_on_a_channel_of_their_own() -> None:
    server, url, queries_url = ParameterServer(), lcm_url(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, lcm_url=url, queries_url=queries_url) as gateway,
    ):
        await publish_frames(server, gateway, 10)
        replies: list[rtc3d.command_reply_t] = []
        again: list[bytes] = []
        peer = open_lcm(queries_url)
        with (
            closing(
                LcmSubscriber(
                    open_lcm(queries_url),
                    "MOCAP_LAB_COMMAND_REPLY",
                    lambda _, each: replies.append(decode(each)),
                )
            ),
            closing(
                LcmSubscriber(
                    open_lcm(queries_url), "MOCAP_LAB_3D_REFILL", lambda _, each: again.append(each)
                )
            ),
        ):
            for number, options in enumerate((["key=3d", "from=3", "to=5"], ["key=3d"], [])):
                request = rtc3d.command_request_t()
                request.request_id, request.requester, request.command = number, "test", "history"
                request.options, request.num_options = options, len(options)
                peer.publish("MOCAP_LAB_COMMAND_REQUEST", request.encode())
                await wait_until_async(lambda: len(replies) == number + 1)  # noqa: B023 - awaited at once
            await wait_until_async(lambda: len(again) == 3)
        facts = {"from": 3, "to": 5, "oldest": 0, "newest": 9, "num_messages": 3}
        assert json.loads(replies[0].content) == {"key": "3d", "channel": "MOCAP_LAB_3D_REFILL", **facts}
        found = await gateway.sources[0].fan_out.find("3d", "lcm", WantedMessages(3, None, 5))
        assert found is not None
        assert again == found.messages
        assert names(replies[1].error, "key=", "from=")
        assert json.loads(replies[2].content)["keys"]["3d"]["newest"] == 9
        assert json.loads(replies[2].content)["num_found"] == {"lcm": 3}


async def test_what_is_too_old_for_the_memory_comes_from_the_last_seconds_on_the_disk(tmp_path: Path) -> None:
    """A subscriber that was away for longer than the memory lasts misses nothing if takes keep the time."""
    server = ParameterServer()
    takes = TakesSettings(enabled=True, directory=str(tmp_path / "takes"), keep_last_s=600.0)
    async with gateway_with_server(server, takes=takes) as (_, _, gateway, peer):
        small = HistorySettings(max_bytes=2048)
        await gateway.reload(gateway.settings.model_copy(update={"history": small}))
        await publish_frames(server, gateway, 200)
        [disk] = [output for output in gateway.outputs if output.name == "takes"]
        await wait_until_async(lambda: disk.oldest_recorded("lab", "3d"))
        assert gateway.sources[0].fan_out.history.overview["keys"]["3d"]["oldest"] > 100
        found: list[bytes] = []
        attachment: dict[str, Any] = {"to": -1, "newest": 199}
        while attachment["to"] < attachment["newest"]:
            reply = await query(peer, f"mocap/lab/3d?from={attachment['to'] + 1}")
            attachment = reply.attachment
            assert (attachment["oldest"], attachment["newest"]) == (0, 199)
            found += unpack_messages(reply.payload)
        assert [sequence_of(each) for each in found] == list(range(200))
        assert [decode(each).markers[0].z for each in found[1:]] == list(range(1, 200))
        assert (await query(peer, "mocap/lab/3d?last_s=1000")).attachment["from"] == 0
        assert (await query(peer, "mocap/lab/3d?from=5;to=7")).attachment["num_messages"] == 3
        assert (await query(peer, "mocap/lab/history")).json["keys"]["3d"]["oldest"] == 0


async def test_a_reload_switches_the_history_off() -> None:
    server = ParameterServer()
    async with gateway_with_server(server) as (_, _, gateway, peer):
        await publish_frames(server, gateway, 2)
        off = HistorySettings(seconds=0)
        assert await gateway.reload(gateway.settings.model_copy(update={"history": off})) == [
            "history changed"
        ]
        reply = await query(peer, "mocap/lab/3d?from=0")
        assert (reply.code, "history.seconds" in reply.error) == ("disabled", True)
