"""A display shows the last seconds at once: over real Zenoh and LCM, from a gateway's history."""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.tools.display.live import DisplayedSource, LiveData
from gateway.tools.display.view.watched import LINGER_S, WatchedSubscriber
from tests.support.networks import free_endpoint, lcm_url
from tests.support.queried_gateway import run_gateway
from tests.support.waiting import wait_until, wait_until_async
from tests.view.published_scene import published_scene

pytestmark = pytest.mark.netns


@pytest.fixture(params=["zenoh", "lcm"])
def where(request: pytest.FixtureRequest) -> Iterator[tuple[dict[str, Any], GatewayAddress]]:
    """The options of a gateway, and where it is found."""
    if request.param == "zenoh":
        endpoint = free_endpoint()
        yield {"listen": endpoint}, GatewayAddress(connect=endpoint)
    else:
        url = lcm_url()
        yield {"lcm_url": url}, GatewayAddress(is_lcm=True, url=url)


def watch(
    address: GatewayAddress, is_seen: Callable[[DisplayedSource], object], **options: Any
) -> DisplayedSource:
    """Receive as a display does until something of a source ``is_seen``; return the source."""
    live = LiveData()

    def update() -> bool:
        subscriber.tick()
        return any(map(is_seen, live.update()))

    with contextlib.closing(GatewayClient(address).subscribe((), None, live, **options)) as subscriber:
        wait_until(update, timeout_s=30)
    [source] = live.sources_now
    return source


async def test_what_a_silent_source_sent_in_the_last_seconds_is_shown(
    where: tuple[dict[str, Any], GatewayAddress],
) -> None:
    """Its server has ended, so nothing but the status arrives: the overview of the history names the rest."""
    options, address = where
    scene = SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=100.0)
    async with contextlib.AsyncExitStack() as stack:
        simulator = await stack.enter_async_context(Simulator(scene))
        gateway = await stack.enter_async_context(run_gateway(simulator.port, **options))
        await wait_until_async(lambda: gateway.sources[0].statuses[0].frames_in > 100)
        await simulator.close()

        def is_seen(source: DisplayedSource) -> bool:
            keys = ("3d", "6d", "analog", "force", "event")
            found = [source.components[key] for key in keys if key in source.components]
            return len(found) == len(keys) and all(each.newest_head is not None for each in found)

        source = await asyncio.to_thread(watch, address, is_seen, last_s=60, patience_s=30)
    assert source.events
    assert source.series_by_key["3d"].num_messages > 100
    assert not any(series.check.num_lost for series in source.series)


async def test_a_page_that_opens_after_a_while_without_one_begins_with_the_last_seconds(
    where: tuple[dict[str, Any], GatewayAddress],
) -> None:
    """Meanwhile the view has received nothing, and the server has ended: only the history has markers."""
    options, address = where
    pages, now_s, live = [1], [0.0], LiveData()
    subscribe = partial(GatewayClient(address).subscribe, (), None, live, last_s=60, patience_s=30)

    def update() -> int:
        watched.tick()
        series = [source.series_by_key["3d"] for source in live.update() if "3d" in source.components]
        return sum(each.num_messages for each in series)

    async with contextlib.AsyncExitStack() as stack:
        simulator = await stack.enter_async_context(Simulator(SyntheticScene(markers=3, rate_hz=100.0)))
        gateway = await stack.enter_async_context(run_gateway(simulator.port, **options))
        await wait_until_async(lambda: all(output.health().connected for output in gateway.outputs))
        watched = await asyncio.to_thread(
            WatchedSubscriber, live, subscribe, lambda: pages, monotonic=lambda: now_s[0]
        )
        await asyncio.to_thread(wait_until, update)
        pages.clear()
        now_s[0] = 2 * LINGER_S
        await asyncio.to_thread(watched.tick)
        assert watched.subscriber is None
        await wait_until_async(lambda: gateway.sources[0].statuses[0].frames_in > 100)
        await simulator.close()
        pages.append(1)
        await asyncio.to_thread(wait_until, lambda: update() > 100)
        watched.close()


def test_a_history_that_does_not_answer_does_not_keep_live_data_from_a_display() -> None:
    """Programs that need everything repeat a request without an answer for a minute."""
    with published_scene([(0.0, 0.0, 0.0)]) as scene:
        unanswered: list[zenoh.Query] = []
        queryable = scene.session.declare_queryable("mocap/lab/*", unanswered.append)
        seen = watch(
            GatewayAddress(connect=scene.endpoint),
            lambda source: "3d" in source.components and source.components["3d"].newest_head is not None,
            last_s=10,
            patience_s=0.2,
        )
        queryable.undeclare()
        assert "mocap/lab/history" in [str(query.key_expr) for query in unanswered]
        assert seen.series_by_key["3d"].check.num_lost == 0
        for query in unanswered:
            query.drop()
