"""What ``gateway.outputs.contract`` promises, for every output that takes whole frames, from open to close.

What only one output promises is tested with that output.
"""

import asyncio
import threading

from gateway.outputs.registry import OUTPUTS
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER
from tests.contract.frame_lab import RIGS, Lab, every_real_rig, every_rig, lab, offered
from tests.contract.frame_rigs import ALL, HALL, LAB, SOURCES, frame, labelled, odd_frames, stamp
from tests.support.waiting import wait_until_async

__all__ = ["lab"]


def test_every_output_of_whole_frames_has_a_rig() -> None:
    for name, kind in OUTPUTS.items():
        if name not in RIGS:
            assert kind.create(kind.settings()).frame_publisher(LAB) is None, name


# Sending -------------------------------------------------------------------------------------


@every_real_rig
async def test_frames_arrive_in_order_under_the_name_of_their_source(lab: Lab) -> None:
    await lab.start()
    sent: dict[str, list[float]] = {source: [] for source in SOURCES}
    for _ in range(20):
        for source, xs in sent.items():
            xs.append(lab.publish_next(source) / 1000)
        await asyncio.sleep(0.005)
    for source, xs in sent.items():
        await wait_until_async(lambda source=source, xs=xs: xs[-1] in lab.xs(source))  # type: ignore[misc]
        assert [x for x in lab.xs(source) if x >= xs[0]] == xs
    assert {source: lab.lost(source) for source in SOURCES} == {source: {} for source in SOURCES}


@every_rig
async def test_frames_that_nobody_receives_do_not_count_as_sent(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    for odd in odd_frames(1).values():
        lab.publish(LAB, odd)
    lab.fan_outs[LAB].publish_status(b"status")
    assert lab.sent() == {}
    await lab.subscribe()
    assert set(lab.sent()) == {"frame"}
    await asyncio.to_thread(lab.rig.unsubscribe)

    def no_longer_counts() -> bool:
        before = lab.sent()
        lab.publish_next()
        return lab.sent() == before

    await wait_until_async(no_longer_counts)


@every_rig
async def test_a_second_peer_receives_as_well(lab: Lab) -> None:
    await lab.start()
    before = len(lab.xs())
    await asyncio.to_thread(lab.rig.subscribe)

    def both_receive() -> bool:
        lab.publish_next()
        xs = lab.xs()[before:]
        return len(xs) > len(set(xs))

    await wait_until_async(both_receive)


@every_rig
async def test_only_frames_for_peers_are_wanted(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    assert not lab.wanted(LAB)
    assert not lab.wanted(HALL)
    await lab.subscribe()
    assert lab.wanted(LAB)
    assert lab.wanted(HALL)
    await asyncio.to_thread(lab.rig.unsubscribe)

    def is_unwanted() -> bool:
        for source in SOURCES:
            lab.publish_next(source)
        return not any(lab.wanted(source) for source in SOURCES)

    await wait_until_async(is_unwanted)
    await lab.subscribe()


@every_rig
async def test_each_change_of_what_is_wanted_is_reported_in_the_event_loop(lab: Lab) -> None:
    threads: list[str] = []
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    assert lab.output.watch_wanted(LAB, lambda: threads.append(threading.current_thread().name))
    lab.output.announce(LAB)
    lab.set_parameters(LAB, labelled())
    lab.serve(HALL)
    await lab.open()
    await asyncio.to_thread(lab.rig.subscribe)
    await wait_until_async(lambda: publisher.wants(WIRE_ORDER))
    await wait_until_async(lambda: threads)
    threads.clear()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await wait_until_async(lambda: not publisher.wants(WIRE_ORDER))
    await wait_until_async(lambda: threads)
    assert set(threads) <= {threading.current_thread().name}
    publisher.close()
    lab.output.withdraw(LAB)


# Life cycle --------------------------------------------------------------------------------------


@every_rig
async def test_an_output_is_healthy_without_peers_from_opening_to_its_first_closing(lab: Lab) -> None:
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    health = lab.output.health()
    assert (health.connected, bool(health.problem)) == (False, True)
    assert offered(publisher, frame(1)) in {"", "not open"}
    lab.serve()
    await lab.open()
    for _ in range(10):
        lab.publish_next()
    assert (lab.output.health().problem, lab.lost()) == ("", {})
    for _ in range(2):
        await asyncio.to_thread(lab.output.close)
    health = lab.output.health()
    assert (health.connected, bool(health.problem)) == (False, True)
    assert offered(publisher, frame(1)) == "not open" or not publisher.wants(WIRE_ORDER)
    publisher.close()
    publisher.close()
    assert offered(publisher, frame(1)) in {"closed", "not open"} or not publisher.wants(WIRE_ORDER)
    lab.output.maintain()
    lab.publish_next()
    assert not lab.output.health().connected


@every_rig
async def test_an_output_that_was_never_started_can_be_closed_twice(lab: Lab) -> None:
    lab.serve()
    for _ in range(2):
        await asyncio.to_thread(lab.output.close)
    assert not lab.output.health().connected


@every_real_rig
async def test_an_output_can_be_replaced_by_one_with_the_same_settings(lab: Lab) -> None:
    """A reload closes the former one first: it has the port."""
    await lab.start()
    await asyncio.to_thread(lab.output.close)
    lab.replace_output()
    for fan_out in lab.fan_outs.values():
        fan_out.set_outputs([lab.output])
    for source in SOURCES:
        lab.set_parameters(source, labelled())
    await lab.open()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
async def test_a_reload_without_changes_disturbs_no_peer(lab: Lab) -> None:
    await lab.start()
    same = lab.rig.create()
    assert lab.output.is_configured_like(same)
    assert lab.output.take_over(same) is False
    await asyncio.to_thread(same.close)
    for source in SOURCES:
        await lab.arrives_next(source)


@every_rig
async def test_a_source_can_be_withdrawn_and_announced_again(lab: Lab) -> None:
    await lab.start()
    lab.fan_outs.pop(LAB).close()
    await lab.arrives_next(HALL)
    lab.serve(LAB)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
async def test_sources_can_be_announced_and_withdrawn_in_any_state(lab: Lab) -> None:
    def show() -> None:
        fan_out = FanOut(LAB, [lab.output])
        lab.set_parameters(LAB, labelled())
        for is_streaming in (True, True, False, False, True):
            fan_out.show_streaming(is_streaming)
        fan_out.publish(frame(1), stamp(), ALL)
        fan_out.close()

    show()
    await lab.open()
    show()
    assert lab.output.health().connected
    await asyncio.to_thread(lab.output.close)
    show()
