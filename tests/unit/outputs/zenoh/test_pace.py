"""What limits how much and how often is sent to Zenoh, on a clock that only the test advances."""

import asyncio
import time
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest

from gateway.errors import OutputError
from gateway.outputs.contract import ServerParameters
from gateway.outputs.zenoh import output as output_module
from gateway.outputs.zenoh.json_publishing import JsonConverter
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.publisher import BURST_BYTES, BURST_S, ZenohLink
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.clocks import Clock, run_in_virtual_time

PARAMETERS = ServerParameters(b"<RT_Parameters/>", 1, 4)


class WaitingClock(Clock):
    """``waits_s`` has the length of each wait."""

    def __init__(self) -> None:
        super().__init__()
        self.waits_s: list[float] = []

    def wait(self, seconds: float) -> None:
        self.waits_s.append(seconds)
        self.now_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> WaitingClock:
    clock = WaitingClock()
    monkeypatch.setattr(time, "monotonic", clock)
    monkeypatch.setattr(time, "sleep", clock.wait)
    return clock


def test_a_burst_begins_two_milliseconds_after_the_one_before_it(clock: WaitingClock) -> None:
    """Without this pace, a subscriber that reads as fast as it can loses more than half of a long burst."""
    link = ZenohLink(lambda: OutputError("not open", cause="not open"))
    waits_s = []
    for later_s in (0.0, 0.0, 0.0015, 0.5, 0.0):
        clock.now_s += later_s
        link.burst_bytes_left = -1
        link.wait_for_pace()
        assert link.burst_bytes_left == BURST_BYTES
        waits_s.append(sum(clock.waits_s))
        clock.waits_s.clear()
    assert waits_s == pytest.approx([0, BURST_S, BURST_S - 0.0015, 0, BURST_S])


def test_the_thread_for_json_rests_four_times_as_long_as_a_conversion_took(clock: WaitingClock) -> None:
    """So a web page costs the gateway a fifth of a core at most."""
    keys = JsonConverter(100)
    keys._closing = SimpleNamespace(wait=clock.wait, is_set=lambda: False)  # type: ignore[assignment]  # a threading.Event
    keys._waiting["lab"].calls.append((lambda: clock.wait(0.01), 1))
    keys._convert_waiting()
    assert clock.waits_s == pytest.approx([0.01, 0.04])


class PublishingOutput(ZenohOutput):
    """Publishes the parameters of "lab" in a list instead of on Zenoh, with the time."""

    def __init__(self) -> None:
        super().__init__(ZenohSettings())
        self.serve_queries(None)  # type: ignore[arg-type]  # nobody asks
        self._parameters["lab"] = PARAMETERS
        self.published_s: list[float] = []

    def _publish_again(self, _source: str) -> Any:
        self.published_s.append(round(self._loop.time() - 1000, 3))
        sent: Any = Future()
        sent.set_result(None)
        return sent


def test_parameters_are_published_for_new_subscribers_at_most_twice_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A peer that appears again and again must not cost more, and gets the parameters in the end."""

    async def appear() -> list[float]:
        loop = asyncio.get_running_loop()
        monkeypatch.setattr(output_module, "time", SimpleNamespace(monotonic=loop.time))
        output = PublishingOutput()
        for _ in range(12):
            for _ in range(3):
                output._publish_soon("lab")
            await asyncio.sleep(0.1)
        await asyncio.sleep(10)
        await output.stop_queries()
        return output.published_s

    published_s = run_in_virtual_time(appear())
    assert published_s == [0, 0.5, 1.0, 1.5]


def test_parameters_have_arrived_when_nothing_can_overtake_them() -> None:
    """Messages of streams have a higher priority: for 50 ms, they may be delivered first."""

    async def publish() -> float:
        output = PublishingOutput()
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        arrived = output.publish_parameters("lab", PARAMETERS)
        assert arrived is not None
        await arrived
        await output.stop_queries()
        return loop.time() - began_s

    assert run_in_virtual_time(publish()) == pytest.approx(0.05)
