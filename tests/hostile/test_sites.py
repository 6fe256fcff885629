"""The configurations in config/sites: two sites, and what may cross the link between them."""

import asyncio
import json
import re
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import pytest
import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.reception import Messages
from gateway.messages.decode import decode, prefix_of
from gateway.outputs.zenoh.output import TEXTS
from tests.support.errors import names
from tests.support.gateway_process import gaps, program, simulator
from tests.support.networks import free_port, open_zenoh
from tests.support.proxy import FuzzingProxy
from tests.support.secure_zenoh import CONFIG, make_certificates, open_session, shipped_file
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

FAKE: Final = b"fake"


class Link:
    """The link between the sites, through a proxy in a thread of its own."""

    def __init__(self, loop: asyncio.AbstractEventLoop, proxy: FuzzingProxy) -> None:
        self._loop = loop
        self._proxy = proxy
        self.port = proxy.port

    def cut(self) -> None:
        """Break the connection. New ones are accepted, but pass nothing until ``mend``."""

        def cut() -> None:
            self._proxy.to_client.stall()
            self._proxy.to_server.stall()
            self._proxy.cut(reset=True)

        self._loop.call_soon_threadsafe(cut)

    def mend(self) -> None:
        self._loop.call_soon_threadsafe(self._proxy.clear)


@contextmanager
def link_to(port: int) -> Iterator[Link]:
    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        thread = threading.Thread(target=loop.run_forever)
        thread.start()
        proxy = FuzzingProxy(port)
        try:
            asyncio.run_coroutine_threadsafe(proxy.__aenter__(), loop).result(60)
            yield Link(loop, proxy)
            asyncio.run_coroutine_threadsafe(proxy.__aexit__(None, None, None), loop).result(60)
        finally:
            loop.call_soon_threadsafe(loop.stop)
            thread.join()


class Sites(NamedTuple):
    """Both sites: the link, where to connect at each of them, and the file of the recorder at site B."""

    link: Link
    site_a: str
    site_b: str
    recorder: Path


@contextmanager
def gateway(folder: Path, name: str, **variables: object) -> Iterator[None]:
    """Run a gateway with a file of config/sites, and settings that override it; yield once frames arrive."""
    values = {f"RTC3D_GATEWAY__{key.upper()}": json.dumps(value) for key, value in variables.items()}
    values |= {
        "RTC3D_GATEWAY__METRICS__ENABLED": "false",
        "RTC3D_GATEWAY__SPOOL__DIRECTORY": str(folder / name / "spool"),
        "RTC3D_GATEWAY__SOURCES__0__HOST": "127.0.0.1",
    }
    log = folder / f"{name}.log"
    arguments = ("run", "--config", str(CONFIG / "sites" / name))
    with log.open("wb") as output, program(*arguments, environ=values, stdout=output, stderr=output):
        wait_until(lambda: "→ streaming" in log.read_text() and TEXTS.opened in log.read_text())
        yield


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sites]:
    """Both sites with the shipped files; only addresses and paths differ."""
    folder = tmp_path_factory.mktemp("sites")
    tls = make_certificates(folder / "tls", "router-a=IP:127.0.0.1", "router-b=IP:127.0.0.1", "recorder-b")
    a_tcp, a_tls, b_tcp, b_tls, rtc3d = (free_port() for _ in range(5))
    paths = ("/etc/rtc3d-gateway/tls", str(tls))
    site_a = ("tcp/192.0.2.10:7447", f"tcp/127.0.0.1:{a_tcp}")
    router = {"zenoh__config__connect__endpoints": [site_a[1]]}
    with ExitStack() as stack:
        router_a = shipped_file(
            "sites/router-a.json5", paths, site_a, ("192.0.2.10:7448", f"127.0.0.1:{a_tls}")
        )
        stack.enter_context(open_session(router_a))
        link = stack.enter_context(link_to(a_tls))
        b_changes = (
            ("198.51.100.10:7447", f"127.0.0.1:{b_tcp}"),
            ("198.51.100.10:7448", f"127.0.0.1:{b_tls}"),
        )
        router_b = shipped_file(
            "sites/router-b.json5", paths, ("192.0.2.10:7448", f"127.0.0.1:{link.port}"), *b_changes
        )
        stack.enter_context(open_session(router_b))
        recorder = folder / "recorder-b.json5"
        recorder.write_text(shipped_file("sites/recorder-b.json5", paths, b_changes[1]))
        port, _ = stack.enter_context(simulator("--rate", "100", "--analog-rate", "100", "--markers", "5"))
        ports = {"sources__0__port": port, "rtc3d__ports": {"lab": rtc3d}}
        stack.enter_context(gateway(folder, "gateway-a.yaml", **ports, **router))
        stack.enter_context(gateway(folder, "gateway-a-30hz.yaml", sources__0__port=rtc3d, **router))
        yield Sites(link, site_a[1], f"tcp/127.0.0.1:{b_tcp}", recorder)


class Received:
    """The messages that a session receives under ``keys``, by key."""

    def __init__(self, session: zenoh.Session, keys: str) -> None:
        self.messages: dict[str, list[bytes]] = {}
        session.declare_subscriber(keys, self._add)

    def _add(self, sample: zenoh.Sample) -> None:
        self.messages.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())

    def wait_for_more(self, key: str, count: int) -> None:
        before = len(self.messages.get(key, ()))
        wait_until(lambda: len(self.messages.get(key, ())) >= before + count)

    def sequences(self, key: str) -> list[int]:
        return [prefix_of(message).sequence for message in list(self.messages[key])]


def replies(session: zenoh.Session, selector: str) -> list[zenoh.Reply]:
    return list(session.get(selector, timeout=5))


def wait_for_reply(session: zenoh.Session, selector: str) -> None:
    wait_until(lambda: any(reply.ok for reply in replies(session, selector)))


def test_no_connection_of_router_b_is_for_the_routers_own_messages() -> None:
    """Zenoh sends them, of priority 0, all on the one that opened first, so that none overtakes another."""
    ranges = re.findall(r"\?prio=(\d)-(\d)", shipped_file("sites/router-b.json5"))
    assert [each for first, last in ranges for each in range(int(first), int(last) + 1)] == [*range(1, 8)]


def test_a_display_at_site_b_gets_paced_data_and_nothing_else(sites: Sites) -> None:
    """Of 100 Hz, every third or fourth frame; nothing comes a second time as JSON."""
    with open_zenoh("client", connect=sites.site_b) as display:
        everything, paced, full = (Received(display, keys) for keys in ("**", "mocap-30hz/**", "mocap/**"))
        paced.wait_for_more("mocap-30hz/lab/3d", 20)
        wait_until(lambda: "mocap-30hz/lab/parameters" in paced.messages)
        frames = [decode(message).frame_number for message in paced.messages["mocap-30hz/lab/3d"]]
        assert min(after - before for before, after in pairwise(frames)) >= 3
        assert not [key for key in everything.messages if not key.startswith("mocap-30hz/lab/")]
        assert not [key for key in paced.messages if key.endswith("/json")]
        assert full.messages == {}
        assert replies(display, "mocap-30hz/lab/status")
        assert replies(display, "mocap/lab/status") == []


@pytest.mark.parametrize("who", ["display", "recorder"])
def test_nobody_at_site_b_publishes_or_starts_a_recording(sites: Sites, who: str) -> None:
    """A query that access control stops gets no reply, at once; one at site A is answered by the gateway."""
    prefix = "mocap" if who == "recorder" else "mocap-30hz"
    with ExitStack() as stack:
        robot = stack.enter_context(open_zenoh("client", connect=sites.site_a))
        received = Received(robot, "**")
        far = (
            stack.enter_context(open_session(sites.recorder.read_text()))
            if who == "recorder"
            else stack.enter_context(open_zenoh("client", connect=sites.site_b))
        )
        wait_for_reply(far, f"{prefix}/lab/status")
        for key in ("lab/recording?set=stop", "lab/take?set=start", "lab/take"):
            assert replies(far, f"{prefix}/{key}") == [], key
            assert replies(robot, f"{prefix}/{key}") != [], key
        for key in ("mocap/lab/3d", "mocap-30hz/lab/3d", "robot/stop"):
            far.put(key, FAKE)
        far.declare_queryable("mocap/lab/status", lambda query: query.reply("mocap/lab/status", FAKE))
        wait_for_reply(far, f"{prefix}/lab/status")  # the routers have processed all of the above
        received.wait_for_more("mocap/lab/3d", 20)
        assert FAKE not in [message for messages in received.messages.values() for message in messages]
        assert FAKE not in [r.ok.payload.to_bytes() for r in replies(robot, "mocap/lab/status") if r.ok]


def test_a_forbidden_command_ends_with_a_sentence(sites: Sites) -> None:
    """Otherwise, who asks would wait for a gateway that never gets the query."""
    with GatewayClient(GatewayAddress(zenoh_config=sites.recorder), timeout_s=10) as client:
        [problem] = client.stop_take(source="lab").problems
    assert names(str(problem), "mocap/lab/take?set=stop", "access control")


def test_a_recorder_at_site_b_is_complete_after_the_link_was_cut_and_site_a_notices_nothing(
    sites: Sites,
) -> None:
    """The recorder gets what it has missed from the history. Site A notices nothing."""
    key, paced = "mocap/lab/3d", "mocap-30hz/lab/3d"
    recorded: list[int] = []

    def receive(_source: str, component: str, message: bytes) -> None:
        if component == "3d":
            recorded.append(prefix_of(message).sequence)

    with (
        open_zenoh("client", connect=sites.site_a) as robot,
        open_zenoh("client", connect=sites.site_b) as display,
        GatewayClient(GatewayAddress(zenoh_config=sites.recorder)) as client,
    ):
        on_site, far = Received(robot, key), Received(display, paced)
        vanished: list[zenoh.Sample] = []
        robot.liveliness().declare_subscriber("mocap/*/alive", vanished.append)
        subscriber = client.subscribe(["lab"], ["3d"], Messages(receive), complete=True)
        try:
            wait_until(lambda: len(recorded) > 20)
            far.wait_for_more(paced, 3)
            sites.link.cut()
            wait_until(lambda: replies(display, "mocap-30hz/lab/status") == [])
            newest_before = on_site.sequences(key)[-1]
            on_site.wait_for_more(key, 100)
            assert recorded[-1] <= newest_before
            sites.link.mend()
            far.wait_for_more(paced, 3)
            newest = on_site.sequences(key)[-1]
            wait_until(lambda: recorded[-1] > newest)
        finally:
            subscriber.close()
        assert gaps(recorded) == []
        assert gaps(on_site.sequences(key)) == []
        assert vanished == []
