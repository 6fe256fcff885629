"""The threads of the outputs: daemons, so that a program does not wait for them, with telling names."""

import asyncio
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import lcm
import pytest

from gateway.messages.topics import Topic
from gateway.outputs.adapters.lsl.output import LslOutput
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.ros2.output import Ros2Output
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.contract import Output
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.queries.service import SourceQueryService
from tests.support.lcm_relay import LcmRelay
from tests.support.networks import zenoh_keys
from tests.support.waiting import wait_until, wait_until_async


@pytest.fixture
def threads() -> Callable[[], dict[str, bool]]:
    """Return a function that returns whether the threads started since then are daemons, by name."""
    earlier = set(threading.enumerate())

    def started() -> dict[str, bool]:
        later = set(threading.enumerate()) - earlier
        return {thread.name: thread.daemon for thread in later if not thread.name.startswith("Dummy-")}

    return started


async def test_zenoh_opens_and_replies_in_threads(threads: Callable[[], dict[str, bool]]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # zenoh.open waits for an answer
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        output = ZenohOutput(ZenohSettings(config=zenoh_keys("client", connect=endpoint)))
        output.serve_queries(SourceQueryService(dict, dict, "zenoh"))
        output.start()
        assert threads() == {"zenoh-open": True}  # the others start when there is something to send
        await output.stop_queries()
        await wait_until_async(lambda: set(threads()) == {"zenoh-open"})
    await asyncio.to_thread(output.close)
    await wait_until_async(lambda: "zenoh-open" not in threads())  # or later tests would see what it logs


async def test_lcm_sends_and_receives_in_threads(threads: Callable[[], dict[str, bool]]) -> None:
    relay = LcmRelay()
    output = LcmOutput(LcmSettings(url=relay.url))
    output.serve_queries(SourceQueryService(dict, dict, "zenoh"))
    output.announce("lab")
    output.start()
    await wait_until_async(lambda: {"lcm-send": True, "lcm-requests": True}.items() <= threads().items())
    await wait_until_async(lambda: output.health().connected and relay.subscribed)
    await output.stop_queries()
    output.close()
    await wait_until_async(lambda: not {"lcm-send", "lcm-requests"} & set(threads()))
    relay.close()


def test_a_subscriber_of_lcm_receives_in_a_thread_until_it_is_closed(
    threads: Callable[[], dict[str, bool]],
) -> None:
    received: list[tuple[str, bytes]] = []
    shared = lcm.LCM("memq://")
    subscriber = LcmSubscriber(shared, "A|B", lambda *each: received.append(each))
    assert threads() == {"lcm-subscriber": True}
    subscriber.close()
    assert threads() == {}
    shared.publish("A", b"late")
    shared.handle_timeout(0)
    assert received == []


def test_zenoh_has_no_thread_for_each_key() -> None:
    """With three sources of 256 tools, no further thread could start, and the gateway stopped working."""
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer")))
    output.start()
    wait_until(lambda: not output._holder._opener._thread.is_alive())
    threads = Path("/proc/self/task")
    num_before = len([*threads.iterdir()])
    publishers = [output.publisher(Topic("lab", ("6d", str(at)), "rtc3d.tool_pose_t")) for at in range(90)]
    assert len([*threads.iterdir()]) < num_before + len(publishers) / 2  # Zenoh's own may grow
    output.close()


def test_zenoh_has_no_thread_for_each_source() -> None:
    """50 sources had 50 threads more than one."""
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer")))
    with asyncio.Runner() as runner:
        runner.run(_serve_queries(output))
        output.start()
        wait_until(lambda: not output._holder._opener._thread.is_alive())
        threads = Path("/proc/self/task")
        num_before = len([*threads.iterdir()])
        for number in range(30):
            output.announce(f"lab{number}")
        num_more = len([*threads.iterdir()]) - num_before
        runner.run(output.stop_queries())
    output.close()
    assert num_more < 15  # Zenoh's own may grow


async def _serve_queries(output: ZenohOutput) -> None:
    output.serve_queries(object())  # type: ignore[arg-type]  # nobody asks


UNUSED = [
    lambda: LcmOutput(LcmSettings()),
    lambda: LslOutput(LslSettings()),
    lambda: Ros2Output(Ros2Settings()),
    lambda: ZenohOutput(ZenohSettings()),
]


@pytest.mark.parametrize("build", UNUSED)
def test_an_output_that_is_never_started_has_no_thread(
    threads: Callable[[], dict[str, bool]], build: Callable[[], Output]
) -> None:
    """A reload builds every output to compare it with the running one, and drops it if they are alike."""
    output = build()
    assert threads() == {}, output.name
