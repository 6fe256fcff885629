"""What frames may contain, for every output that takes whole frames."""

import asyncio
from typing import Final

import numpy as np
import pytest

from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.rtc3d.parameters import Parameters
from tests.contract.frame_lab import Lab, converts, every_rig, lab, returns
from tests.contract.frame_rigs import (
    ALL,
    HALL,
    LAB,
    SOURCES,
    component,
    frame,
    frame_of,
    labelled,
    odd_frames,
    stamp,
    tools,
    world,
)
from tests.support.waiting import wait_until_async

__all__ = ["lab"]

NUM_LABELS: Final = 2000

WEIRD_LABELS: Final = (
    *("", " ", "/", "//", "a/b", "..", "*", "$*", "#", "?", "@", "%2F", "{}", "~", "-", "0", "7th", "tf"),
    *(
        "Probe 1",
        "probe_1",
        "PROBE 1",
        "Probe 1",
        "\n",
        "\t",
        "\x00",
        "\x1b[2J",
        "\u202e",
        "\ud7ff",
        "é",
        "左足",
        "🦶",
    ),
    *("a" * 300, "é" * 300, "<b>", "&amp;", '"', "'", "\\", "status", "clock", "json", "None", "nan"),
)


async def subscribe_again(lab: Lab, version: int) -> None:
    """Give LAB its usual parameters again, and subscribe to its streams anew."""
    lab.set_parameters(LAB, labelled(), version)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
@pytest.mark.parametrize("name", odd_frames(1))
async def test_frames_may_lack_or_repeat_components(lab: Lab, name: str) -> None:
    await lab.start()
    number = lab.publish_next()
    odd = odd_frames(number)[name]
    lab.publish(LAB, odd)
    lab.publish(LAB, odd)
    await lab.arrives()
    assert lab.lost() == {}
    assert set(lab.xs()) <= {each / 1000 for each in range(1, number + 10_000)}


@every_rig
async def test_only_the_components_that_the_gateway_publishes_are_sent(lab: Lab) -> None:
    await lab.start()
    x = (number := lab.publish_next()) / 1000
    await wait_until_async(lambda: x in lab.xs())
    lab.fan_outs[LAB].publish(frame(number + 500_000), stamp(), ALL - {ComponentType.TOOLS})
    await lab.arrives()
    if lab.rig.converts:
        assert not [each for each in lab.xs() if each > 500]


@every_rig
async def test_a_source_may_have_no_parameters(lab: Lab) -> None:
    for source in SOURCES:
        lab.fan_outs[source] = FanOut(source, [lab.output])
        lab.set_parameters(source, Parameters())
    await lab.open()
    await lab.subscribe()
    assert lab.lost() == {}


@every_rig
async def test_tools_may_come_and_go(lab: Lab) -> None:
    """With other labels and another number of them, as after a new definition in the server."""
    await lab.start()
    for version, num_tools in enumerate((5, 1, 3, 2), 2):
        lab.set_parameters(LAB, labelled(tools=[f"Tool {version} {at}" for at in range(num_tools)]), version)
        for number in (10_000 * version, 10_000 * version + 1):
            items = tools(number, *[np.nan] * (num_tools - 1))
            lab.publish(LAB, frame_of(component(number, ComponentType.TOOLS, items)), stamp(version))
    await subscribe_again(lab, 6)
    assert not set(lab.lost()) - {"queue full"}


@every_rig
async def test_labels_may_be_no_valid_names(lab: Lab) -> None:
    await lab.start()
    lab.set_parameters(LAB, labelled(markers=WEIRD_LABELS, tools=WEIRD_LABELS), 2)
    for number in (1, 2):
        items = tools(number, *[np.nan] * (len(WEIRD_LABELS) - 1))
        lab.publish(LAB, frame_of(component(number, ComponentType.TOOLS, items)), stamp(2))
    await lab.arrives_next(HALL)
    await subscribe_again(lab, 3)


@every_rig
async def test_thousands_of_labels_disturb_nobody(lab: Lab) -> None:
    """What an output cannot send of them is counted; another source is served meanwhile."""
    await lab.start()
    labels = [f"label {at}" for at in range(NUM_LABELS)]
    lab.set_parameters(LAB, labelled(markers=labels, tools=labels), 2)
    markers = np.zeros(NUM_LABELS, ITEM_DTYPES[ComponentType.MARKERS])
    huge = frame_of(
        component(1, ComponentType.MARKERS, markers),
        component(1, ComponentType.TOOLS, tools(*range(1, NUM_LABELS + 1))),
        component(1, ComponentType.ANALOG, np.zeros(NUM_LABELS, ITEM_DTYPES[ComponentType.ANALOG])),
    )
    for _ in range(5):
        await returns(lambda: lab.publish(LAB, huge, stamp(2)))
        await lab.arrives_next(HALL)
    await subscribe_again(lab, 3)


@converts
async def test_positions_are_in_metres_in_the_frame_of_the_source(lab: Lab) -> None:
    """A reload changes only the frame and the version: the parameters stay."""
    await lab.start()
    lab.set_parameters(LAB, labelled(), 2, world(1.0, turned=True, x_m=10.0))

    def has_arrived() -> bool:
        lab.publish(LAB, frame(3), stamp(2))  # again: on LSL, peers need another stream
        return 7.0 in lab.xs()

    await wait_until_async(has_arrived)


@converts
async def test_without_a_known_unit_no_position_is_sent_and_the_loss_is_counted(lab: Lab) -> None:
    await lab.start()
    lab.set_parameters(LAB, labelled(), 2, world(None))
    lab.publish(LAB, frame(1_000_000), stamp(2))
    await wait_until_async(lambda: lab.lost().get("unknown unit"))
    await lab.arrives_next(HALL)
    lab.set_parameters(LAB, labelled(), 3)
    await lab.arrives()
    assert not [x for x in lab.xs() if x >= 1000]
