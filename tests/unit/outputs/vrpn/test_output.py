"""The VRPN output as the gateway uses it: sources, parameters, whole frames."""

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncIterator, Sequence

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.messages.topics import Topic
from gateway.outputs import loop_thread
from gateway.outputs.contract import FramePublisher, ServerParameters
from gateway.outputs.vrpn.output import VrpnOutput
from gateway.outputs.vrpn.settings import VrpnSettings
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import Frame, encode_frame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from tests.losses import amounts
from tests.networks import free_port
from tests.vrpn_client import VrpnClient
from tests.waiting import wait_until_async

ALL = frozenset(ComponentType)
STILL = (1.0, 0.0, 0.0, 0.0)


def parameters(labels: Sequence[str], version: int = 1, unit_m: float | None = 1e-3) -> ServerParameters:
    parsed = Parameters(tools=Parameters6D(100.0, tuple(Tool("", label) for label in labels)))
    return ServerParameters(b"", 1, version, parsed=parsed, frame=CoordinateFrame("lab", unit_m))


def tools_component(x_mm: Sequence[float], order: ByteOrder = "big") -> bytes:
    items = np.array([(*STILL, x, 0.0, 0.0, 0.0) for x in x_mm], ITEM_DTYPES[ComponentType.TOOLS])
    return encode_component(ComponentType.TOOLS, 1, 1000, items, order)


def tools_frame(*x_mm: float, order: ByteOrder = "big") -> Frame:
    return split_frame(encode_frame([tools_component(x_mm, order)], order), order)


def stamp(utime: int) -> Stamp:
    return Stamp(utime + 5, utime, 1, 1)


class Lab:
    """A running output with the source lab, and a connected client."""

    def __init__(self, output: VrpnOutput, publisher: FramePublisher, client: VrpnClient) -> None:
        self.output = output
        self.publisher = publisher
        self.client = client
        self.losses = Losses(logging.getLogger(__name__), "lab to vrpn")
        output.count_losses("lab", self.losses)

    async def poses(self, count: int) -> list[tuple[str, int, float]]:
        """Return the name, the time and x in m of each pose, once there are ``count`` of them."""
        await wait_until_async(lambda: len(self.client.poses) >= count)
        return [(pose.name, pose.utime, pose.values[0]) for pose in self.client.poses]


@contextlib.asynccontextmanager
async def lab(labels: Sequence[str] = ("wand", "foot"), unit_m: float | None = 1e-3) -> AsyncIterator[Lab]:
    settings = VrpnSettings(enabled=True, port=free_port())
    output = VrpnOutput(settings)
    publisher = output.frame_publisher("lab")
    assert publisher is not None
    output.start()
    await wait_until_async(lambda: output.health().connected)
    output.publish_parameters("lab", parameters(labels, unit_m=unit_m))
    async with await VrpnClient.connect(settings.port) as client:
        await wait_until_async(lambda: publisher.wants(WIRE_ORDER) and len(client.trackers) == len(labels))
        yield Lab(output, publisher, client)
    await asyncio.to_thread(output.close)
    output.close()
    assert not publisher.wants(WIRE_ORDER)


async def test_frames_of_both_byte_orders_and_with_two_components() -> None:
    async with lab() as here:
        here.publisher.publish(tools_frame(1000.0, 2000.0), stamp(10), 0, ALL)
        here.publisher.publish(tools_frame(3000.0, order="little"), stamp(20), 1, ALL)
        twice = split_frame(encode_frame([tools_component([4000.0]), tools_component([5000.0])]), "big")
        here.publisher.publish(twice, stamp(30), 2, ALL)
        assert await here.poses(5) == [
            *(("wand", 10, 1.0), ("foot", 10, 2.0), ("wand", 20, 3.0)),
            *(("wand", 30, 4.0), ("wand", 30, 5.0)),
        ]


async def test_only_frames_with_tools_for_a_client_are_wanted() -> None:
    markers = np.zeros(3, ITEM_DTYPES[ComponentType.MARKERS])
    without = split_frame(encode_frame([encode_component(ComponentType.MARKERS, 1, 1000, markers)]), "big")
    async with lab() as here:
        prepare = here.publisher.prepare
        assert prepare(tools_frame(math.nan).layout, ALL)
        assert not prepare(tools_frame(1000.0).layout, frozenset([ComponentType.MARKERS]))
        assert not prepare(without.layout, ALL)
        assert not prepare(tools_frame().layout, ALL)
    assert not prepare(tools_frame(1000.0).layout, ALL)


async def test_tools_out_of_view_send_nothing() -> None:
    async with lab() as here:
        here.publisher.publish(tools_frame(math.nan, 2000.0), stamp(40), 3, ALL)
        assert await here.poses(1) == [("foot", 40, 2.0)]


async def test_frames_are_named_by_the_parameters_before_them() -> None:
    async with lab() as here:
        here.publisher.publish(tools_frame(1000.0), stamp(10), 0, ALL)
        here.output.publish_parameters("lab", parameters(["hand", "foot"], 2))
        here.publisher.publish(tools_frame(2000.0), stamp(20), 1, ALL)
        assert await here.poses(2) == [("wand", 10, 1.0), ("hand", 20, 2.0)]


async def test_frame_with_more_tools_than_the_parameters() -> None:
    async with lab() as here:
        here.publisher.publish(tools_frame(1000.0, 2000.0, 3000.0), stamp(10), 0, ALL)
        assert (await here.poses(3))[2] == ("tool_3", 10, 3.0)
        assert here.output.topic_names("lab") == {"6d": {"tool 3": "tool_3"}}


async def test_unknown_unit_is_refused() -> None:
    async with lab(unit_m=None) as here:
        with pytest.raises(OutputError, match="unit of length 'mm' is unknown") as refused:
            here.publisher.publish(tools_frame(1.0), stamp(10), 0, ALL)
        assert refused.value.cause == "unknown unit"


async def test_frames_that_wait_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    async with lab() as here:
        monkeypatch.setattr(loop_thread, "MAX_CALLS", 0)
        causes = []
        for sequence in range(200):
            try:
                here.publisher.publish(tools_frame(1.0), stamp(10), sequence, ALL)
            except OutputError as error:
                causes.append(error.cause)
        assert set(causes) == {"queue full"}
        await here.poses(200 - len(causes))


async def test_tools_without_a_tracker_are_counted() -> None:
    async with lab() as here:
        here.publisher.publish(tools_frame(*(1.0,) * 260), stamp(10), 0, ALL)
        await here.poses(256)
        assert amounts(here.losses.report()) == {"too many tools": (4, 1)}


async def test_poses_of_a_frame_are_bounded_over_all_its_components() -> None:
    async with lab() as here:
        components = [tools_component([1000.0] * 100) for _ in range(5)]
        here.publisher.publish(split_frame(encode_frame(components), "big"), stamp(10), 0, ALL)
        await here.poses(256)
        assert amounts(here.losses.report()) == {"too many tools": (244, 1)}


async def test_gateway_is_told_when_the_first_client_comes_and_the_last_one_goes() -> None:
    settings = VrpnSettings(enabled=True, port=free_port())
    output = VrpnOutput(settings)
    publisher = output.frame_publisher("lab")
    assert publisher is not None
    told: list[bool] = []
    assert output.watch_wanted("lab", lambda: told.append(publisher.wants(WIRE_ORDER)))
    output.start()
    await wait_until_async(lambda: output.health().connected)
    async with await VrpnClient.connect(settings.port) as first:
        await wait_until_async(lambda: told == [True])
        async with await VrpnClient.connect(settings.port) as second:
            await wait_until_async(lambda: first.types and second.types)
    await wait_until_async(lambda: told == [True, False])
    await asyncio.to_thread(output.close)


async def test_source_that_is_withdrawn_has_no_trackers() -> None:
    async with lab() as here:
        other = here.output.frame_publisher("stage")
        assert other is not None
        here.output.publish_parameters("stage", parameters(["wand"]))
        await wait_until_async(lambda: set(here.client.trackers.values()) >= {"lab/wand", "stage/wand"})
        other.close()
        here.output.withdraw("stage")
        await wait_until_async(lambda: here.output.topic_names("lab") == {})
        here.output.publish_parameters("stage", parameters(["wand"]))  # changes nothing
        here.publisher.publish(tools_frame(1000.0), stamp(10), 0, ALL)
        assert await here.poses(1) == [("wand", 10, 1.0)]


def test_output_that_is_not_open_needs_no_clients() -> None:
    output = VrpnOutput(VrpnSettings(enabled=True, port=free_port()))
    publisher = output.frame_publisher("lab")
    assert publisher is not None
    output.publish_parameters("lab", parameters(["wand"]))
    publisher.publish(tools_frame(1.0), stamp(10), 0, ALL)
    assert not publisher.wants(WIRE_ORDER)
    assert "does not listen" in output.health().problem
    publisher.close()
    output.close()
    output.close()


def test_topics_are_accepted_and_never_wanted() -> None:
    publisher = VrpnOutput(VrpnSettings()).publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    publisher.publish(b"")
    assert not publisher.wanted


def test_reload_keeps_an_output_with_the_same_settings() -> None:
    output = VrpnOutput(VrpnSettings(port=4000))
    same, other = VrpnOutput(VrpnSettings(port=4000)), VrpnOutput(VrpnSettings(port=4001))
    assert output.is_configured_like(same)
    assert not output.take_over(same)
    assert not output.is_configured_like(other)


async def test_defect_in_the_servers_thread_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with lab() as here:
        with monkeypatch.context() as patched:
            patched.setattr("gateway.outputs.vrpn.publisher.encode_pose", None)
            for sequence in range(3):
                here.publisher.publish(tools_frame(1.0), stamp(10), sequence, ALL)
            await wait_until_async(lambda: "defect in the gateway: TypeError" in caplog.text)
        here.publisher.publish(tools_frame(2000.0), stamp(20), 3, ALL)
        assert (await here.poses(1))[-1] == ("wand", 20, 2.0)
    assert caplog.text.count("defect in the gateway") == 1
