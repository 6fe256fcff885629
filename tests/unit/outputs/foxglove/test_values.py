"""The values that viewers get: positions, forces, numbers, and what cannot be sent."""

import math

import numpy as np
import pytest

from gateway.foxglove_schemas import messages
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.rtc3d.components import MISSING, ByteOrder
from gateway.rtc3d.parameters import (
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersForce,
    Tool,
)
from tests.foxglove_viewer import viewing
from tests.unit.export.read_mcap import floats_of, points_of
from tests.unit.outputs.foxglove.live import (
    ANALOG,
    EVENT,
    FORCE,
    MARKERS,
    PLATE,
    QUARTER_TURN,
    TOOLS,
    UTIME,
    channels,
    frame_of,
    pose,
    serving,
)


@pytest.mark.parametrize("order", ["big", "little"])
async def test_positions_are_in_the_frame_of_the_source(order: ByteOrder) -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers", "/lab/tools") as viewer:
        lab.set_parameters(Parameters(tools=Parameters6D(100.0, (Tool("1", "cup"),))), 1, QUARTER_TURN)
        await lab.wait_until_wanted()
        lab.publish(
            frame_of(
                {MARKERS: [(MISSING,) * 4, (1000, 2000, 3000, 0.5)], TOOLS: [pose(1000, 2000, 3000)]}, order
            )
        )
        [cloud] = await viewer.wait_for("/lab/markers")
        assert (cloud.content.frame_id, cloud.time_ns) == ("hall", UTIME * 1000)
        assert np.allclose(points_of(cloud.content).tolist(), [(8, 1, 3, 0.5, 1)])
        [transforms] = await viewer.wait_for("/lab/tools")
        [cup] = transforms.content.transforms
        assert (cup.parent_frame_id, cup.child_frame_id) == ("hall", "lab/cup")
        p, q = cup.translation, cup.rotation
        assert np.allclose((p.x, p.y, p.z), (8, 1, 3))
        assert np.allclose((q.x, q.y, q.z, q.w), QUARTER_TURN.rotation_xyzw)


async def test_forces_act_in_the_frame_of_the_source() -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/forces") as viewer:
        turned = CoordinateFrame("hall", 1e-3, (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), (0.0, 0.0, 1.0))
        lab.set_parameters(
            Parameters(force=ParametersForce((PLATE,))), 1, turned
        )  # y becomes z, z becomes -y
        await lab.wait_until_wanted()
        lab.publish_items(FORCE, [(0, 0, 500, 0, 0, 0)])
        [update] = await viewer.wait_for("/lab/forces")
        [arrow] = update.content.entities[0].arrows
        p, q = arrow.pose.position, arrow.pose.orientation
        assert np.allclose((p.x, p.y, p.z), (0.3, 0, 1.2))
        assert arrow.shaft_length + arrow.head_length == pytest.approx(0.5)
        # The arrow along x is turned to -y.
        assert np.allclose((2 * (q.x * q.y + q.w * q.z), q.w**2 + q.x**2 - q.y**2 - q.z**2), (-1, 0))


async def test_without_a_known_unit_no_position_is_sent_and_the_loss_is_counted() -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers", "/lab/events") as viewer:
        lab.set_parameters(
            Parameters(markers=Parameters3D(100.0, "furlong")), 1, CoordinateFrame("lab", None)
        )
        await lab.wait_until_wanted()
        lab.publish(frame_of({MARKERS: [(1, 2, 3, 0)], EVENT: [(7, 0, 1, 2, 3)]}))
        await viewer.wait_for("/lab/events")
        assert lab.losses == {"unknown unit": (1, 1)}
        assert not viewer.received["/lab/markers"]


async def test_what_viewers_cannot_show_is_left_out_and_counted() -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers") as viewer:
        await lab.wait_until_wanted()
        lab.publish_items(MARKERS, [(1, 2, 3, 0)], utime=-1)
        lab.publish_items(ANALOG, range(10_001))
        lab.publish_items(MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers")
        assert lab.losses == {"time out of range": (1, 1), "too many numbers": (1, 1)}
        assert "/lab/analog" not in viewer.topics


async def test_numbers_are_also_in_cdr_as_messages_of_ros_2() -> None:
    """PlotJuggler 3.17 takes nothing else. It needs names that begin with a letter."""
    async with serving("lab-2") as (port, [lab]):
        lab.set_parameters(channels("EMG 1", "1", "n_1", "", "_"))
        async with viewing(port, "/lab-2/analog/cdr") as viewer:
            channel = viewer.channel("/lab-2/analog/cdr")
            assert channel["schemaName"] == "rtc3d_lab_2/msg/Analog"
            assert channel["schema"].splitlines() == [
                f"float32 {name}" for name in ("EMG_1", "n_1", "n_1_2", "channel_4", "channel_5")
            ]
            await lab.wait_until_wanted()
            lab.publish_items(ANALOG, [1, -2.5, math.nan, 4, 5])
            [analog] = await viewer.wait_for("/lab-2/analog/cdr")
            # The CDR header, then 1.0, -2.5, … as 32-bit numbers, little-endian.
            assert analog.data[:12] == bytes.fromhex("00010000 0000803f 000020c0")
            assert [analog.content.EMG_1, analog.content.n_1, analog.content.channel_5] == [1, -2.5, 5]
            assert math.isnan(analog.content.n_1_2)


async def test_thousands_of_channels_have_a_field_each() -> None:
    async with serving("lab") as (port, [lab]):
        labels = [f"EMG {number}" for number in range(5000)]
        lab.set_parameters(channels(*labels))
        async with viewing(port, "/lab/analog") as viewer:
            await lab.wait_until_wanted()
            lab.publish_items(ANALOG, range(5000))
            [analog] = await viewer.wait_for("/lab/analog")
            assert list(floats_of(analog.content).values()) == list(range(5000))


async def test_a_defect_in_one_message_is_logged_once_and_others_are_sent(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(messages.FoxgloveSource, "_cloud", lambda *_: 1 / 0)
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers", "/lab/events") as viewer:
        await lab.wait_until_wanted()
        for _ in range(5):
            lab.publish_items(MARKERS, [(1, 2, 3, 0)])
            lab.publish_items(EVENT, [(7, 0, 1, 2, 3)])
        await viewer.wait_for("/lab/events", 5)
    [error] = [record for record in caplog.records if record.levelname == "ERROR"]
    assert "defect in the gateway: ZeroDivisionError" in error.getMessage()
