"""Faults of the server and of the network, alone and several at once; after them, data flows again."""

import asyncio
import threading
from collections.abc import Coroutine
from contextlib import AsyncExitStack
from itertools import pairwise
from typing import Any, TypeVar

import pytest
import uvloop
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.simulator.simulator import KINDS, Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.gateways import MemoryGateway, run_gateway
from tests.support.networks import free_port
from tests.support.proxy import FuzzingProxy
from tests.support.waiting import wait_until_async

_Result = TypeVar("_Result")

MAX_FRAMES_IN_TRANSIT = 20  # when a fault ends
TIMEOUTS = {"reply_timeout_s": 1.0, "stall_timeout_s": 1.0}  # only they end some faults


def scene() -> SyntheticScene:
    return SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=200, analog_rate_hz=200)


def assert_well_formed(lab: MemoryGateway) -> None:
    """Check that every message decodes, and that there are no duplicates and no gaps in the sequences."""
    for component in COMPONENTS_BY_KEY:
        messages = lab.messages(component)  # decodes each
        if messages:
            first = messages[0].sequence
            assert [message.sequence for message in messages] == list(range(first, first + len(messages)))
        identities = [(message.session, message.frame_number, message.timestamp) for message in messages]
        goes_back = any(
            after < before
            for earlier, later in pairwise(identities)
            for before, after in zip(earlier, later, strict=True)
            if earlier[0] == later[0]
        )
        if not goes_back:
            assert len(set(identities)) == len(identities)


async def wait_for_data(lab: MemoryGateway) -> None:
    """Wait for more frames than may have been in transit. The time limit allows for slow CI."""
    before = lab.status.frames_in
    await wait_until_async(lambda: lab.status.frames_in > before + MAX_FRAMES_IN_TRANSIT)


@pytest.mark.parametrize("kind", sorted(KINDS))
async def test_after_each_fault_data_flows_again(kind: str) -> None:
    async with (
        Simulator(scene(), port=free_port()) as simulator,
        run_gateway(simulator.port, **TIMEOUTS) as lab,
    ):
        await lab.wait_for("3d", 20)
        fault = simulator.faults.begin(KINDS[kind].model_validate({}))
        # Wait until the fault has an effect: it changed something, or the gateway noticed it.
        frames = simulator.frames_sent
        await wait_until_async(
            lambda: fault.num_happened or lab.status.last_error or simulator.frames_sent > frames + 100
        )
        await simulator.faults.clear()
        await wait_for_data(lab)
        assert_well_formed(lab)


class ManyFaults(RuleBasedStateMachine):
    """Faults of the server and of the network between it and the gateway, in any order, several at once.

    The event loop of simulator, proxy and gateway has its own thread; the rules act in it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._loop = uvloop.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._stack = AsyncExitStack()
        self._in_loop(self._start())

    def _in_loop(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(240)

    async def _start(self) -> None:
        self.simulator = await self._stack.enter_async_context(Simulator(scene(), port=free_port()))
        self.proxy = await self._stack.enter_async_context(FuzzingProxy(self.simulator.port))
        self.lab = await self._stack.enter_async_context(run_gateway(self.proxy.port, **TIMEOUTS))
        await self.lab.wait_for("3d")

    @rule(kind=st.sampled_from(sorted(KINDS)))
    def begin_a_fault_of_the_server(self, kind: str) -> None:
        async def begin() -> None:
            self.simulator.faults.begin(KINDS[kind].model_validate({}))

        self._in_loop(begin())

    @rule(fault=st.sampled_from(["cut", "cut_after", "stall", "corrupt", "split", "slow"]))
    def begin_a_fault_of_the_network(self, fault: str) -> None:
        async def begin() -> None:
            direction = self.proxy.to_client
            match fault:
                case "cut":
                    self.proxy.cut(reset=True)
                case "cut_after":
                    self.proxy.cut_after(num_bytes=77)
                case "stall":
                    direction.stall()
                case "corrupt":
                    direction.corrupt_share = 0.001
                case "split":
                    direction.segment_bytes = 7
                case _:
                    direction.bytes_per_s = 20_000.0

        self._in_loop(begin())

    @rule(frames=st.integers(1, 60))
    def wait_for_frames(self, frames: int) -> None:
        def progress() -> int:
            return self.simulator.frames_sent + self.lab.status.reconnects

        enough = progress() + frames
        self._in_loop(wait_until_async(lambda: progress() >= enough or bool(self.simulator.faults.active)))

    @rule()
    def recover(self) -> None:
        async def clear() -> None:
            self.proxy.clear()
            await self.simulator.faults.clear()
            await wait_for_data(self.lab)

        self._in_loop(clear())

    def teardown(self) -> None:
        try:
            self.recover()
            self._in_loop(self._check())
        finally:
            self._in_loop(self._stack.aclose())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(10)
            self._loop.close()

    async def _check(self) -> None:
        assert_well_formed(self.lab)


def test_data_flows_again_after_several_faults_at_once() -> None:
    run_state_machine_as_test(
        ManyFaults,
        settings=settings(max_examples=8, stateful_step_count=8, suppress_health_check=list(HealthCheck)),
    )
