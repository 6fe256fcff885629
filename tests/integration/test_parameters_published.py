"""Parameters published without a query, to present and to late subscribers."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest
import rtc3d
import zenoh
import zenoh.ext

from gateway.gateway import Gateway
from gateway.messages.decode import decode
from gateway.outputs.lcm import parameters as lcm_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_endpoint, free_port, lcm_url, open_zenoh
from tests.queried_gateway import (
    ParameterServer,
    parameters_xml,
    query,
    run_gateway,
    wait_until_cached,
    zenoh_peer,
)
from tests.servers import ScriptedServer, markers_frame
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns
KEY = "mocap/lab/parameters"


class Subscribers:
    """A plain Zenoh subscriber, a Zenoh subscriber with a history, and an LCM subscriber."""

    def __init__(self, session: zenoh.Session, url: str) -> None:
        self._session = session
        self.plain: list[bytes] = []
        self.versions: list[int] = []
        """The version that came with each message of ``plain``."""
        self.with_history: list[bytes] = []
        self.lcm: list[rtc3d.parameters_t] = []
        self._subscribers = [session.declare_subscriber(KEY, self._receive)]
        self._advanced = subscribe_with_history(session, self.with_history)
        self._lcm_subscriber = LcmSubscriber(
            open_lcm(url), "MOCAP_LAB_PARAMETERS", lambda _channel, data: self.lcm.append(decode(data))
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        self.versions.append(json.loads(sample.attachment.to_bytes())["parameters_version"])
        self.plain.append(sample.payload.to_bytes())

    async def wait_for(self, xml: bytes) -> None:
        """Wait until ``xml`` is the newest message that each subscriber has received."""
        await wait_until_async(lambda: self.plain and self.plain[-1] == xml)
        await wait_until_async(lambda: self.with_history and self.with_history[-1] == xml)
        await wait_until_async(lambda: self.lcm and self.lcm[-1].xml.encode() == xml)

    def close(self) -> None:
        self._lcm_subscriber.close()


def subscribe_with_history(
    session: zenoh.Session, received: list[bytes]
) -> zenoh.ext.AdvancedSubscriber[None]:
    return zenoh.ext.declare_advanced_subscriber(
        session,
        KEY,
        lambda sample: received.append(sample.payload.to_bytes()),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )


@asynccontextmanager
async def gateway_with_cache(server: ParameterServer, router: str, url: str) -> AsyncIterator[Gateway]:
    """Run ``server`` and a gateway on Zenoh and LCM that has cached its parameters."""
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, router=router, lcm_url=url) as gateway,
    ):
        await wait_until_cached(gateway)
        yield gateway


@pytest.fixture
def url() -> str:
    return lcm_url()


@pytest.fixture
def subscribers(router: str, url: str) -> Iterator[Subscribers]:
    session = open_zenoh("client", connect=router)
    subscribers = Subscribers(session, url)
    yield subscribers
    subscribers.close()
    session.close()


async def test_parameters_are_published_for_every_connection(
    router: str, url: str, subscribers: Subscribers
) -> None:
    port = free_port()
    async with run_gateway(port, router=router, lcm_url=url) as gateway:
        first, second = ParameterServer("Marker before"), ParameterServer("Marker after")
        async with ScriptedServer(first.script, port):
            await subscribers.wait_for(first.xml)
            [message, *_] = subscribers.lcm
            assert (message.sequence, message.session, message.parameters_version) == (0, 1, 1)
            assert set(subscribers.versions) == {1}
            assert message.capture_utime <= message.utime
        async with ScriptedServer(second.script, port):
            await subscribers.wait_for(second.xml)
            assert subscribers.lcm[-1].session > message.session
            assert (subscribers.lcm[-1].parameters_version, subscribers.versions[-1]) == (2, 2)
            await wait_until_cached(gateway)
            with zenoh_peer(router) as peer:
                reply = await query(peer, KEY)
                assert (reply.payload, reply.attachment["parameters_version"]) == (second.xml, 2)
                assert (await query(peer, "mocap/lab/3d")).attachment["parameters_version"] == 2


async def test_parameters_are_published_again_after_a_restart_of_the_gateway(
    router: str, url: str, subscribers: Subscribers
) -> None:
    server = ParameterServer()
    async with ScriptedServer(server.script) as listening:
        async with run_gateway(listening.port, router=router, lcm_url=url):
            await subscribers.wait_for(server.xml)
        server.xml = parameters_xml("Changed meanwhile")
        async with run_gateway(listening.port, router=router, lcm_url=url):
            await subscribers.wait_for(server.xml)
            assert subscribers.lcm[-1].session == 1


async def test_the_first_subscribers_get_the_parameters_although_they_are_late(
    router: str, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lcm_parameters, "REPEAT_S", 0.05)
    server = ParameterServer()
    async with gateway_with_cache(server, router, url):
        commands = list(server.commands)
        session = open_zenoh("client", connect=router)
        subscribers = Subscribers(session, url)
        try:
            await subscribers.wait_for(server.xml)
            sequences = [message.sequence for message in subscribers.lcm]
            assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
            assert server.commands == commands
        finally:
            subscribers.close()
            session.close()


async def test_only_the_late_subscriber_with_a_history_gets_the_parameters_again(
    router: str, url: str, subscribers: Subscribers
) -> None:
    server = ParameterServer()
    async with gateway_with_cache(server, router, url):
        await subscribers.wait_for(server.xml)
        late: list[bytes] = []
        session = open_zenoh("client", connect=router)
        try:
            with zenoh_peer(router) as peer:
                await query(peer, KEY)  # its reply arrives after everything published before
                num_before = len(subscribers.plain)
                subscriber = subscribe_with_history(session, late)
                await wait_until_async(lambda: late)
                await query(peer, KEY)
            assert late == [server.xml]
            assert len(subscribers.plain) == num_before
            subscriber.undeclare()
        finally:
            session.close()


async def test_a_change_found_by_a_fresh_query_is_published(
    router: str, url: str, subscribers: Subscribers
) -> None:
    server = ParameterServer()
    async with gateway_with_cache(server, router, url):
        await subscribers.wait_for(server.xml)
        server.xml = parameters_xml("One more", "Marker 1")
        with zenoh_peer(router) as peer:
            assert (await query(peer, f"{KEY}?fresh=true")).payload == server.xml
            await subscribers.wait_for(server.xml)
            server.xml = parameters_xml("Another")
            assert b"Another" in (await query(peer, f"{KEY}/3d?fresh=true")).payload
            await subscribers.wait_for(server.xml)  # all parameters, although the query was for one section
            assert b"Another" in (await query(peer, f"{KEY}/3d")).payload


async def test_a_change_of_the_statistics_is_not_published(
    router: str, url: str, subscribers: Subscribers
) -> None:
    server = ParameterServer()
    async with gateway_with_cache(server, router, url):
        await subscribers.wait_for(server.xml)
        num_lcm, num_plain = len(subscribers.lcm), len(subscribers.plain)
        server.xml = server.xml.replace(b"<FramesSent>1<", b"<FramesSent>22<")
        with zenoh_peer(router) as peer:
            assert b">22<" in (await query(peer, f"{KEY}?fresh=true")).payload
        server.xml = parameters_xml("Other")
        with zenoh_peer(router) as peer:
            await query(peer, f"{KEY}?fresh=true")
        await subscribers.wait_for(server.xml)
        published = [message.xml.encode() for message in subscribers.lcm[num_lcm:]]
        published += subscribers.plain[num_plain:]
        assert not any(b">22<" in xml for xml in published)


async def test_no_frame_is_lost_while_two_hundred_queries_are_answered(router: str) -> None:
    scene = SyntheticScene(markers=10, tools=2, analog=4, plates=1, rate_hz=200, analog_rate_hz=200)
    sequences: list[int] = []
    async with Simulator(scene) as simulator:
        simulator.stop_measurement()
        async with run_gateway(simulator.port, router=router) as gateway:
            [source] = gateway.sources
            await wait_until_async(lambda: source.statuses[0].state.value == "no measurement")
            with zenoh_peer(router) as peer:
                peer.declare_subscriber(
                    "mocap/lab/3d",
                    lambda sample: sequences.append(decode(sample.payload.to_bytes()).sequence),
                )
                await wait_until_async(lambda: source.fan_out.has_subscribers(source.queries.components))
                simulator.start_measurement()
                keys = ("parameters?fresh=true", "parameters/3d", "6d", "*?format=json")
                for start in range(0, 200, 20):
                    selectors = [f"mocap/lab/{keys[number % 4]}" for number in range(start, start + 20)]
                    await asyncio.gather(*(expect_replies(peer, selector) for selector in selectors))
                await wait_until_async(lambda: len(sequences) > 50)
                simulator.stop_measurement()
                await wait_until_async(lambda: len(sequences) >= simulator.components_sent["3d"])
    assert sequences == list(range(simulator.components_sent["3d"]))


async def expect_replies(peer: zenoh.Session, selector: str) -> None:
    """Send a query; it must have replies and no error."""
    replies = await asyncio.to_thread(lambda: list(peer.get(selector, timeout=20)))
    assert replies
    assert all(reply.ok is not None for reply in replies)


async def test_frames_between_a_command_and_its_reply_are_published() -> None:
    server, endpoint = ParameterServer(), free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint) as gateway,
    ):
        await wait_until_cached(gateway)
        published = gateway.sources[0].fan_out
        with zenoh_peer(endpoint) as peer:
            server.may_answer.clear()
            before = server.count("SendParameters")
            asked = asyncio.create_task(query(peer, f"{KEY}?fresh=true"))
            await wait_until_async(lambda: server.count("SendParameters") > before)
            for number in range(8, 108):
                server.send(markers_frame(number, (1.0, 2.0, 3.0)))
            await wait_until_async(lambda: published.frames[ComponentType.MARKERS] == 101)
            assert not asked.done()
            server.may_answer.set()
            assert (await asked).payload == server.xml
            newest = decode(published.newest(ComponentType.MARKERS, "zenoh") or b"")
            assert (newest.frame_number, newest.sequence) == (107, 100)  # one frame, then one hundred
