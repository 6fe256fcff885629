"""``start``, ``publish`` and ``maintain`` return at once, whatever the peer does.

A call that blocks would hang a test, so the calls run in a thread, and the test fails if it does not end.
"""

import asyncio
import json
import signal
import socket
import sys
import threading
from asyncio.subprocess import PIPE
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gateway.errors import OutputError
from gateway.outputs.contract import Output, ServerFile, ServerParameters
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.contract.rigs import ANALOG, MARKERS
from tests.support.lcm_relay import LcmRelay
from tests.support.networks import free_endpoint, lcm_url, zenoh_keys
from tests.support.waiting import wait_until_async

RETURNS_WITHIN_S = 8
NUM_MESSAGES = 12_000
LARGE_MESSAGE = bytes(20_000)
"""All messages together are larger than every buffer on the way."""

HOUR_MS = 3_600_000
PATIENT = {
    "transport": {
        "shared_memory": {"enabled": False},
        "link": {
            "tx": {
                "lease": HOUR_MS,
                "queue": {"congestion_control": {"block": {"wait_before_close": 10_000_000}}},
            }
        },
    }
}
"""Keys with which Zenoh keeps a stalled link for 10 s (given in µs) instead of 5 s: past RETURNS_WITHIN_S."""


SUBSCRIBER = """
import sys, time, zenoh

def opened():
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
        except zenoh.ZError:  # the output does not listen yet
            time.sleep(0.1)

session = opened()
session.declare_subscriber("mocap/**", lambda _: print("received", flush=True))
sys.stdin.read()
"""


class StalledPeer(NamedTuple):
    """An output, what makes its peer stall, and the causes of the drops that follow."""

    output: Output
    stall: Callable[[], Awaitable[None]]
    causes: set[str]


async def already_stalled() -> None:
    """Do nothing: the peer never answered."""


class _NoSources:
    """A query service without sources; the outputs call nothing else of it here."""

    def serves(self, _source: str) -> bool:
        return False


# The peers -----------------------------------------------------------------------------------


@contextmanager
def silent_server() -> Iterator[int]:
    """Accept connections and never say anything; yield the port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]  # the kernel accepts connections for a listening socket


@asynccontextmanager
async def zenoh_router_that_never_answers() -> AsyncIterator[StalledPeer]:
    with silent_server() as port:
        config = zenoh_keys("client", connect=f"tcp/127.0.0.1:{port}")
        yield StalledPeer(ZenohOutput(ZenohSettings(config=config)), already_stalled, {"not open"})


@asynccontextmanager
async def zenoh_subscriber_that_stops_reading() -> AsyncIterator[StalledPeer]:
    """Run a subscriber in a process of its own, and stop that process."""
    endpoint = free_endpoint()
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer", listen=endpoint) | PATIENT))
    keys = json.dumps(zenoh_keys("client", connect=endpoint) | PATIENT)
    subscriber = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", SUBSCRIBER, keys), stdin=PIPE, stdout=PIPE
    )

    async def stall() -> None:
        publisher = output.publisher(MARKERS)
        await wait_until_async(lambda: publisher.wanted)
        publisher.publish(b"the first")
        assert subscriber.stdout is not None
        await subscriber.stdout.readline()
        subscriber.send_signal(signal.SIGSTOP)

    try:
        yield StalledPeer(output, stall, set())
    finally:
        subscriber.kill()
        await subscriber.wait()
        # All sessions of a process share Zenoh's threads. Later tests fail if one still waits for this peer.
        await wait_until_async(lambda: not sending_threads(), 120)


@asynccontextmanager
async def lcm_relay_that_never_answers() -> AsyncIterator[StalledPeer]:
    with silent_server() as port:
        output = LcmOutput(LcmSettings(url=f"tcpq://127.0.0.1:{port}"))
        yield StalledPeer(output, already_stalled, {"not open"})


@asynccontextmanager
async def lcm_relay_that_stops_reading() -> AsyncIterator[StalledPeer]:
    relay = LcmRelay()
    output = LcmOutput(LcmSettings(url=relay.url))

    async def stall() -> None:
        await wait_until_async(lambda: output.health().connected)
        relay.stop_reading()

    yield StalledPeer(output, stall, {"queue full"})
    relay.close()


@asynccontextmanager
async def lcm_relay_for_requests_that_never_answers() -> AsyncIterator[StalledPeer]:
    with silent_server() as port:
        settings = LcmSettings(url=lcm_url(), queries_url=f"tcpq://127.0.0.1:{port}")
        yield StalledPeer(LcmOutput(settings), already_stalled, set())


@pytest.fixture(
    params=[
        zenoh_router_that_never_answers,
        zenoh_subscriber_that_stops_reading,
        lcm_relay_that_never_answers,
        lcm_relay_that_stops_reading,
        pytest.param(lcm_relay_for_requests_that_never_answers, marks=pytest.mark.netns),
    ],
    ids=lambda peer: peer.__name__,
)
async def peer(request: pytest.FixtureRequest) -> AsyncIterator[StalledPeer]:
    async with request.param() as peer:
        yield peer


def sending_threads() -> list[threading.Thread]:
    """Return the threads of Zenoh outputs that have not ended."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("zenoh-send")]


# The tests -----------------------------------------------------------------------------------


async def returns(call: Callable[[], Any]) -> None:
    """Make a call in a thread that nobody has to wait for; fail if it does not return."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    await wait_until_async(lambda: not thread.is_alive(), RETURNS_WITHIN_S)


async def test_no_call_of_the_event_loop_blocks(peer: StalledPeer) -> None:
    output = peer.output
    drops: Counter[str] = Counter()
    publishers = [output.publisher(MARKERS), output.publisher(ANALOG)]
    output.serve_queries(_NoSources())  # type: ignore[arg-type]  # it has the only method that is called

    def publish_much() -> None:
        for number in range(NUM_MESSAGES):
            try:
                publishers[number % 2].publish(LARGE_MESSAGE if number % 10 == 0 else b"short")
            except OutputError as error:
                drops[error.cause] += 1
            if number % 1000 == 0:
                output.maintain()

    def do_everything_else() -> None:
        output.announce("lab")
        output.show_streaming("lab", True)
        output.publish_parameters("lab", ServerParameters(bytes(100_000), 1, 1))
        output.announce_file("lab", ServerFile(Path("take.c3d"), 7))
        output.publisher(MARKERS).close()
        output.show_streaming("lab", False)
        output.withdraw("lab")
        output.maintain()
        output.health()

    await returns(output.start)
    await peer.stall()
    await returns(publish_much)
    await returns(do_everything_else)
    assert set(drops) == peer.causes
    await output.stop_queries()
    await returns(output.close)
