"""What viewers get: channels, subscriptions, descriptions and values."""

import asyncio
import errno
import logging
import math
import socket
from functools import partial
from typing import Any

import numpy as np
import pytest

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.foxglove import messages, plates, topics
from gateway.outputs.adapters.foxglove.output import FoxgloveOutput
from gateway.outputs.adapters.foxglove.server import FoxgloveServer
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.rtc3d.components import MISSING, WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D, Parameters6D, ParametersForce, Tool
from tests.support.errors import names
from tests.support.foxglove_viewer import HandshakeRefusedError, Viewer, viewing
from tests.support.networks import free_port
from tests.support.waiting import wait_until_async
from tests.unit.outputs.adapters.foxglove.live import (
    ANALOG,
    EVENT,
    FORCE,
    ITEMS,
    MARKERS,
    PLATE,
    QUARTER_TURN,
    TOOLS,
    UTIME,
    channels,
    frame_of,
    serving,
    watching,
)
from tests.unit.takes.export.read_mcap import floats_of, points_of

ALWAYS = {
    "/lab/markers": "foxglove.PointCloud",
    "/lab/tools": "foxglove.FrameTransforms",
    "/lab/events": "foxglove.Log",
    "/lab/forces": "foxglove.SceneUpdate",
    "/lab/plates": "foxglove.SceneUpdate",
    "/lab/parameters": "rtc3d.Parameters",
}
PLATES = Parameters(force=ParametersForce((PLATE,)))

# Channels ---------------------------------------------------------------------------------------


async def test_the_channels_of_each_source_are_advertised_before_it_has_frames() -> None:
    async with serving("lab", "hall") as (port, [lab, _]), viewing(port) as viewer:
        await viewer.wait_until(lambda: len(viewer.topics) == 2 * len(ALWAYS))
        assert (viewer.info["name"], viewer.info["capabilities"]) == ("rtc3d-gateway", [])
        assert {name: schema for name, schema in viewer.topics.items() if "/lab/" in name} == ALWAYS
        lab.set_parameters(channels("EMG 1", "EMG 2"))
        await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog")
    async with serving("lab") as (port, _), viewing(port) as again:
        assert again.info["sessionId"] != viewer.info["sessionId"]


async def test_channels_of_numbers_appear_with_the_first_frame_if_there_are_no_parameters() -> None:
    async with watching(given=Parameters()) as (lab, viewer):
        frame = frame_of({ANALOG: [1, 2], FORCE: ITEMS[FORCE]})
        lab.publish(frame)
        await viewer.wait_until(lambda: {"/lab/analog", "/lab/loads"} <= viewer.topics.keys())
        assert not lab.wanted
        viewer.subscribe("/lab/analog", "/lab/loads")
        [analog] = (await lab.publish_until(frame, lambda: viewer.received["/lab/analog"]))[:1]
        assert floats_of(analog.content) == {"channel_1": 1, "channel_2": 2}
        [loads] = (await viewer.wait_for("/lab/loads"))[:1]
        assert floats_of(loads.content) == {
            f"plate_1_{load}": number for number, load in enumerate(("fx", "fy", "fz", "mx", "my", "mz"), 1)
        }


async def test_channels_of_numbers_that_the_parameters_do_not_mention_appear_with_a_frame() -> None:
    """Of another stream than the one that a viewer watches."""
    async with watching("/lab/markers", given=Parameters(markers=Parameters3D(100.0))) as (lab, viewer):
        lab.publish(frame_of({MARKERS: [], ANALOG: []}))
        lab.publish_items(ANALOG)
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)
        lab.set_parameters(channels("EMG 1"), 2)
        await viewer.wait_until(lambda: viewer.channel("/lab/analog")["schemaName"] == "rtc3d.lab.Analog_2")
        viewer.withdrawn.clear()
        lab.set_parameters(Parameters(), 3)
        await viewer.wait_until(lambda: "/lab/analog" in viewer.withdrawn)
        lab.publish_items(ANALOG)
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)


async def test_channels_are_withdrawn_with_their_source_and_come_back_with_it() -> None:
    async with serving("lab", "hall") as (port, [lab, hall]), viewing(port, "/lab/markers") as viewer:
        await lab.wait_until_wanted()
        lab.fan_out.set_outputs(())
        await viewer.wait_until(lambda: not any(name.startswith("/lab/") for name in viewer.topics))
        assert set(viewer.withdrawn) == ALWAYS.keys()
        lab.fan_out.set_outputs([hall.output])
        await viewer.wait_until(lambda: viewer.topics.keys() >= ALWAYS.keys())
        assert not lab.wanted
        viewer.subscribe("/lab/markers")
        await lab.wait_until_wanted()
        lab.publish_items(MARKERS)
        await viewer.wait_for("/lab/markers")


async def test_other_labels_of_channels_replace_the_topic_by_one_with_another_schema() -> None:
    async with watching("/lab/analog", given=channels("EMG 1", "EMG 2")) as (lab, viewer):
        lab.set_parameters(channels("EMG 1", "EMG 2"), 2)
        lab.publish_items(ANALOG, [1, 2])
        await viewer.wait_for("/lab/analog")
        assert viewer.withdrawn == []
        withdrawn = viewer.channel("/lab/analog")["id"]
        lab.set_parameters(channels("left", "right", "time"), 3)
        await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog_2")
        assert set(viewer.withdrawn) == {"/lab/analog", "/lab/analog/cdr"}
        await lab.wait_until_wanted(False)
        viewer.send({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": withdrawn}]})
        viewer.subscribe("/lab/analog")
        await lab.wait_until_wanted()
        assert viewer.warnings == []
        lab.publish_items(ANALOG, [1, 2, 3])
        _, after = await viewer.wait_for("/lab/analog", 2)
        assert floats_of(after.content) == {"left": 1, "right": 2, "time": 3}


async def test_a_topic_of_numbers_disappears_with_its_parameters_and_comes_back_with_them() -> None:
    async with watching("/lab/loads", "/lab/events", given=PLATES) as (lab, viewer):
        lab.set_parameters(channels("EMG 1"), 2)
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics and "/lab/loads" not in viewer.topics)
        assert set(viewer.withdrawn) == {"/lab/loads", "/lab/loads/cdr"}
        assert lab.wanted
        lab.publish_items(EVENT)
        await viewer.wait_for("/lab/events")
        lab.set_parameters(PLATES, 3)
        await viewer.wait_until(lambda: "/lab/loads" in viewer.topics)
        viewer.subscribe("/lab/loads")
        await lab.publish_until(frame_of({FORCE: ITEMS[FORCE]}), lambda: viewer.received["/lab/loads"])


async def test_a_number_of_channels_that_goes_up_and_down_is_counted_and_not_followed_each_time() -> None:
    async with watching("/lab/analog", "/lab/markers", given=channels("a", "b")) as (lab, viewer):
        three = frame_of({ANALOG: range(3)})
        lab.publish(three)
        await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog_2")
        viewer.subscribe("/lab/analog")
        await lab.publish_until(three, lambda: viewer.received["/lab/analog"])
        for number in range(100):
            lab.publish_items(ANALOG, range(number % 2 + 2))
        lab.publish_items(MARKERS)
        await viewer.wait_for("/lab/markers")
        assert lab.losses["labels change too often"] == (50, 50)
        assert sorted(viewer.withdrawn) == ["/lab/analog", "/lab/analog/cdr"]


# Subscriptions --------------------------------------------------------------------------------


async def test_the_components_of_the_topics_that_viewers_subscribe_to_are_wanted() -> None:
    """Frames without any of them do not count as sent."""
    async with watching("/lab/markers", "/lab/plates", given=channels("EMG 1")) as (lab, viewer):
        assert [kind for kind in WIRE_ORDER if lab.fan_out.has_subscribers([kind])] == [MARKERS]
        lab.publish_items(TOOLS)
        lab.publish_items(MARKERS)
        await viewer.wait_for("/lab/markers")
        [(_, status)] = lab.fan_out.outputs
        assert status.messages == {"frame": 1}
        for topic, kind in (("/lab/analog/cdr", ANALOG), ("/lab/forces", FORCE), ("/lab/events", EVENT)):
            viewer.subscribe(topic)
            await wait_until_async(partial(lab.fan_out.has_subscribers, [kind]))
        assert not lab.fan_out.has_subscribers([TOOLS])
        viewer.unsubscribe("/lab/markers")
        await wait_until_async(lambda: not lab.fan_out.has_subscribers([MARKERS]))
        assert lab.wanted


async def test_nothing_is_converted_but_what_somebody_subscribes_to(monkeypatch: pytest.MonkeyPatch) -> None:
    converted: list[str] = []
    for owner, name in (
        (messages.FoxgloveSource, "_clouds"),
        (messages.FoxgloveSource, "_transforms"),
        (topics.ProtobufRecord, "encode_rows"),
        (topics.CdrRecord, "encode_rows"),
        (messages.FoxgloveSource, "_logs"),
        (plates.PlateScene, "arrows"),
    ):
        original = getattr(owner, name)

        def spy(*arguments: object, name: str = name, original: object = original) -> object:
            converted.append(name)
            return original(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(owner, name, spy)
    everything = frame_of(ITEMS)
    async with watching("/lab/loads", given=PLATES) as (lab, viewer):
        lab.publish(everything)
        await viewer.wait_for("/lab/loads")
        assert converted == ["encode_rows"]
        viewer.unsubscribe("/lab/loads")
        await lab.wait_until_wanted(False)
        lab.publish(everything)
        viewer.subscribe("/lab/forces", "/lab/events")
        await lab.wait_until_wanted()
        lab.publish(everything)
        await viewer.wait_for("/lab/events")
        assert sorted(converted) == ["_logs", "arrows", "encode_rows"]


async def test_viewers_have_their_own_subscriptions_and_speak_one_of_two_protocols() -> None:
    async with (
        serving("lab") as (port, [lab]),
        viewing(port, "/lab/markers", subprotocol="foxglove.websocket.v1") as first,
        viewing(port, "/lab/markers", "/lab/tools") as second,
    ):
        assert (first.subprotocol, second.subprotocol) == ("foxglove.websocket.v1", "foxglove.sdk.v1")
        await lab.publish_until(
            frame_of(ITEMS), lambda: first.received["/lab/markers"] and second.received["/lab/tools"]
        )
        assert not first.received["/lab/tools"]
        with pytest.raises(HandshakeRefusedError, match="400"):
            await Viewer.open(port, "chat")


async def test_requests_that_make_no_sense_are_answered_with_an_error_and_change_nothing() -> None:
    async with watching("/lab/markers") as (lab, viewer):
        markers, tools = (viewer.channel(topic)["id"] for topic in ("/lab/markers", "/lab/tools"))
        [used] = viewer.subscriptions

        async def answer(request: dict[str, Any]) -> str:
            viewer.warnings.clear()
            viewer.send(request)
            await viewer.wait_until(lambda: viewer.warnings)
            [text] = viewer.warnings
            return text

        def subscribe(*wanted: tuple[int, int]) -> dict[str, Any]:
            found = [{"id": number, "channelId": channel} for number, channel in wanted]
            return {"op": "subscribe", "subscriptions": found}

        many = [(number, 99999) for number in range(1000)]
        assert "channel 99999" in await answer(subscribe(*many))
        assert names(await answer(subscribe((7, markers))), f"channel {markers}", "already")
        assert f"subscription {used} exists already" in await answer(subscribe((used, tools)))
        viewer.send({"op": "unsubscribe", "subscriptionIds": [9]})  # it may have ended with its channel
        for op in ("advertise", "getParameters", "subscribeConnectionGraph"):
            assert names(await answer({"op": op}), "subscribe", "unsubscribe")
        viewer.received.clear()
        lab.publish(frame_of(ITEMS))
        lab.publish_items(MARKERS)
        await viewer.wait_for("/lab/markers", 2)
        assert viewer.received.keys() == {"/lab/markers"}


# Descriptions ----------------------------------------------------------------------------------


async def test_parameters_and_plates_are_sent_to_each_viewer_that_subscribes_and_when_they_change() -> None:
    described = Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "knee"),)), force=PLATES.force)
    frame = {
        "frame_id": "hall",
        "metres_per_unit": 1e-3,
        "rotation_xyzw": list(QUARTER_TURN.rotation_xyzw),
        "translation_m": [10, 0, 0],
    }
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(described, 3, QUARTER_TURN)
        for _ in range(2):
            async with viewing(port, "/lab/parameters", "/lab/plates") as viewer:
                [content] = [each.content for each in await viewer.wait_for("/lab/parameters")]
                found = (content["version"], content["3d"]["labels"], content["frame"])
                assert found == (3, ["knee"], frame)
                [plates] = await viewer.wait_for("/lab/plates")
                [entity] = plates.content.entities
                assert (entity.frame_id, entity.id) == ("hall", "left")
                corners = [(p.x, p.y) for p in entity.lines[0].points]
                assert np.allclose(corners, [(9.6, 0.6), (9.6, 0), (10, 0), (10, 0.6)])
        async with viewing(port, "/lab/parameters", "/lab/plates") as viewer:
            await viewer.wait_for("/lab/plates")
            # The server says mm, and the settings that its positions are in m: plates have their own unit.
            lab.set_parameters(described, 4, CoordinateFrame("hall", metres_per_unit=2.0, scale=2.0))
            [entity] = (await viewer.wait_for("/lab/plates", 2))[1].content.entities
            corners = [(p.x, p.y) for p in entity.lines[0].points]
            assert np.allclose(corners, [(1.2, 0.8), (0, 0.8), (0, 0), (1.2, 0)])
            lab.set_parameters(Parameters(), 5)
            assert not (await viewer.wait_for("/lab/plates", 3))[2].content.entities
            assert [log.content["version"] for log in viewer.received["/lab/parameters"]] == [3, 4, 5]
            assert not lab.wanted


async def test_names_of_fields_that_are_not_the_labels_can_be_queried() -> None:
    async with watching(given=channels("EMG 1", "EMG_1", "time")) as (lab, viewer):
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)
        assert lab.output.topic_names("lab") == {"analog": {"EMG 1": "EMG_1", "EMG_1": "EMG_1_2"}}
        assert lab.output.topic_names("none") == {}


# Values ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["big", "little"])
async def test_positions_and_forces_are_in_the_frame_of_the_source(order: ByteOrder) -> None:
    given = Parameters(tools=Parameters6D(100.0, (Tool("1", "cup"),)), force=PLATES.force)
    async with watching("/lab/markers", "/lab/tools", "/lab/forces") as (lab, viewer):
        lab.set_parameters(given, 1, QUARTER_TURN)
        items: dict[ComponentType, list[Any]] = {
            MARKERS: [(MISSING,) * 4, (1000, 2000, 3000, 0.5)],
            TOOLS: [(1, 0, 0, 0, 1000, 2000, 3000, 0.1)],
            FORCE: [(300, 0, 400, 0, 0, 0)],
        }
        lab.publish(frame_of(items, order))
        [cloud] = await viewer.wait_for("/lab/markers")
        assert (cloud.content.frame_id, cloud.time_ns) == ("hall", UTIME * 1000)
        assert np.allclose(points_of(cloud.content).tolist(), [(8, 1, 3, 0.5, 1)])
        [transforms] = await viewer.wait_for("/lab/tools")
        [cup] = transforms.content.transforms
        assert (cup.parent_frame_id, cup.child_frame_id) == ("hall", "lab/cup")
        p, q = cup.translation, cup.rotation
        assert np.allclose((p.x, p.y, p.z), (8, 1, 3))
        assert np.allclose((q.x, q.y, q.z, q.w), QUARTER_TURN.rotation_xyzw)
        [update] = await viewer.wait_for("/lab/forces")
        [arrow] = update.content.entities[0].arrows
        q = arrow.pose.orientation
        along = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y))
        assert np.allclose(along, (0, 0.6, 0.8))


async def test_what_viewers_cannot_show_is_left_out_and_counted() -> None:
    async with watching("/lab/markers") as (lab, viewer):
        lab.publish_items(MARKERS, utime=-1)
        lab.publish_items(ANALOG, range(10_001))
        lab.publish_items(MARKERS)
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
            names = ("emg_1", "n1", "n_1", "channel_4", "channel_5")
            assert channel["schema"].splitlines() == [f"float32 {name}" for name in names]
            await lab.wait_until_wanted()
            lab.publish_items(ANALOG, [1, -2.5, math.nan, 4, 5])
            [analog] = await viewer.wait_for("/lab-2/analog/cdr")
            # The CDR header, then 1.0, -2.5, … as 32-bit numbers, little-endian.
            assert analog.data[:12] == bytes.fromhex("00010000 0000803f 000020c0")
            assert [getattr(analog.content, name) for name in names] == pytest.approx(
                [1, -2.5, math.nan, 4, 5], nan_ok=True
            )


async def test_a_defect_in_one_message_is_logged_once_and_others_are_sent(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(messages.FoxgloveSource, "_clouds", lambda *_: 1 / 0)
    async with watching("/lab/markers", "/lab/events") as (lab, viewer):
        for _ in range(5):
            lab.publish_items(MARKERS)
            lab.publish_items(EVENT)
        await viewer.wait_for("/lab/events", 5)
    [error] = [record for record in caplog.records if record.levelname == "ERROR"]
    assert names(error.getMessage(), "ZeroDivisionError")


# The port ------------------------------------------------------------------------------------------


async def test_an_output_that_is_closed_while_it_opens_releases_the_port() -> None:
    for _ in range(10):
        output = FoxgloveOutput(FoxgloveSettings(enabled=True, host="localhost", port=free_port()))
        output.start()
        await asyncio.to_thread(output.close)
        assert not output.health().connected
        with socket.create_server(("127.0.0.1", output.settings.port)):
            pass


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (KeyError("x"), "KeyError"),
        (OSError(errno.EADDRINUSE, "x"), "foxglove.port"),
        (OSError(errno.EADDRNOTAVAIL, "x"), "foxglove.host"),
    ],
)
async def test_no_failure_ends_the_attempts_to_listen(
    error: Exception, problem: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    errors, opened = [error, error], FoxgloveServer.open

    async def open_or_fail(server: FoxgloveServer) -> None:
        if errors:
            raise errors.pop()
        await opened(server)

    monkeypatch.setattr(FoxgloveServer, "open", open_or_fail)
    output = FoxgloveOutput(FoxgloveSettings(enabled=True, port=free_port()))
    output.start()
    try:
        await wait_until_async(lambda: problem in output.health().problem)
        await wait_until_async(lambda: output.health().connected)
    finally:
        output.close()
    assert sum(record.levelno >= logging.WARNING for record in caplog.records) == 1
