"""What viewers get: channels, subscriptions, descriptions and values."""

import asyncio
import socket
from functools import partial
from typing import Any

import numpy as np
import pytest

from gateway.foxglove_schemas import float_topics, forces, messages
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.foxglove.output import FoxgloveOutput
from gateway.outputs.foxglove.server import FoxgloveServer
from gateway.outputs.foxglove.settings import FoxgloveSettings
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import (
    Marker,
    Parameters,
    Parameters3D,
    ParametersForce,
)
from tests.foxglove_viewer import HandshakeRefusedError, Viewer, viewing
from tests.networks import free_port
from tests.unit.export.read_mcap import floats_of
from tests.unit.outputs.foxglove.live import (
    ANALOG,
    EVENT,
    FORCE,
    MARKERS,
    PLATE,
    QUARTER_TURN,
    TOOLS,
    channels,
    frame_of,
    pose,
    serving,
)
from tests.waiting import wait_until_async

ALWAYS = {
    "/lab/markers": "foxglove.PointCloud",
    "/lab/tools": "foxglove.FrameTransforms",
    "/lab/events": "foxglove.Log",
    "/lab/forces": "foxglove.SceneUpdate",
    "/lab/plates": "foxglove.SceneUpdate",
    "/lab/parameters": "rtc3d.Parameters",
}
# Channels ---------------------------------------------------------------------------------------


async def test_the_channels_of_each_source_are_advertised_before_it_has_frames() -> None:
    async with serving("lab", "hall") as (port, [lab, _]), viewing(port) as viewer:
        await viewer.wait_until(lambda: len(viewer.topics) == 2 * len(ALWAYS))
        assert viewer.info["name"] == "rtc3d-gateway"
        assert viewer.info["capabilities"] == []
        assert {name: schema for name, schema in viewer.topics.items() if "/lab/" in name} == ALWAYS
        lab.set_parameters(channels("EMG 1", "EMG 2"))
        await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog")
    async with serving("lab") as (port, _), viewing(port) as again:
        assert again.info["sessionId"] != viewer.info["sessionId"]


async def test_channels_of_numbers_appear_with_the_first_frame_if_there_are_no_parameters() -> None:
    async with serving("lab") as (port, [lab]), viewing(port) as viewer:
        lab.set_parameters(Parameters())
        frame = frame_of({ANALOG: [1, 2], FORCE: [(1, 2, 3, 4, 5, 6)]})
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
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers") as viewer:
        lab.set_parameters(Parameters(markers=Parameters3D(100.0)))
        await lab.wait_until_wanted()
        lab.publish(frame_of({MARKERS: [], ANALOG: []}))
        lab.publish(frame_of({ANALOG: [1]}))
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)
        lab.set_parameters(channels("EMG 1"), 2)
        await viewer.wait_until(lambda: viewer.channel("/lab/analog")["schemaName"] == "rtc3d.lab.Analog_2")
        viewer.withdrawn.clear()
        lab.set_parameters(Parameters(), 3)
        await viewer.wait_until(lambda: "/lab/analog" in viewer.withdrawn)
        lab.publish(frame_of({ANALOG: [1]}))
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
        lab.publish_items(MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers")


async def test_other_labels_of_channels_replace_the_topic_by_one_with_another_schema() -> None:
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(channels("EMG 1", "EMG 2"))
        async with viewing(port, "/lab/analog") as viewer:
            await lab.wait_until_wanted()
            lab.set_parameters(channels("EMG 1", "EMG 2"), 2)
            lab.publish_items(ANALOG, [1, 2])
            await viewer.wait_for("/lab/analog")
            assert viewer.withdrawn == []
            lab.set_parameters(channels("left", "right", "time"), 3)
            await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog_2")
            assert set(viewer.withdrawn) == {"/lab/analog", "/lab/analog/cdr"}
            await lab.wait_until_wanted(False)
            viewer.subscribe("/lab/analog")
            await lab.wait_until_wanted()
            lab.publish_items(ANALOG, [1, 2, 3])
            _, after = await viewer.wait_for("/lab/analog", 2)
            assert floats_of(after.content) == {"left": 1, "right": 2, "time": 3}


async def test_a_topic_of_numbers_disappears_with_its_parameters_and_comes_back_with_them() -> None:
    plates = Parameters(force=ParametersForce((PLATE,)))
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(plates)
        async with viewing(port, "/lab/loads", "/lab/events") as viewer:
            lab.set_parameters(channels("EMG 1"), 2)
            await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)
            await viewer.wait_until(lambda: "/lab/loads" not in viewer.topics)
            assert set(viewer.withdrawn) == {"/lab/loads", "/lab/loads/cdr"}
            assert lab.wanted
            lab.publish_items(EVENT, [(7, 0, 1, 2, 3)])
            await viewer.wait_for("/lab/events")
            lab.set_parameters(plates, 3)
            await viewer.wait_until(lambda: "/lab/loads" in viewer.topics)
            viewer.subscribe("/lab/loads")
            await lab.publish_until(
                frame_of({FORCE: [(1, 2, 3, 4, 5, 6)]}), lambda: viewer.received["/lab/loads"]
            )


async def test_a_number_of_channels_that_goes_up_and_down_is_counted_and_not_followed_each_time() -> None:
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(channels("a", "b"))
        async with viewing(port, "/lab/analog", "/lab/markers") as viewer:
            await lab.wait_until_wanted()
            lab.publish_items(ANALOG, range(3))
            await viewer.wait_until(lambda: viewer.topics.get("/lab/analog") == "rtc3d.lab.Analog_2")
            viewer.subscribe("/lab/analog")
            lab.publish_items(ANALOG, range(3))
            while not viewer.received["/lab/analog"]:
                lab.publish_items(ANALOG, range(3))
                await asyncio.sleep(0)
            for number in range(100):
                lab.publish_items(ANALOG, range(number % 2 + 2))
            lab.publish_items(MARKERS, [(1, 2, 3, 0)])
            await viewer.wait_for("/lab/markers")
            assert lab.losses["labels change too often"] == (50, 50)
            assert sorted(viewer.withdrawn) == ["/lab/analog", "/lab/analog/cdr"]


# Subscriptions --------------------------------------------------------------------------------


async def test_a_source_is_wanted_while_a_viewer_subscribes_to_its_frames() -> None:
    async with serving("lab", "hall") as (port, [lab, hall]):
        await lab.wait_until_wanted(False)
        async with viewing(port, "/lab/markers") as first:
            await lab.wait_until_wanted()
            async with viewing(port, "/lab/tools", "/lab/parameters"):
                first.unsubscribe("/lab/markers")
                first.subscribe("/hall/plates")
                first.subscribe("/hall/parameters")
                first.subscribe("/hall/events")
                await hall.wait_until_wanted()
                await lab.wait_until_wanted()
            await lab.wait_until_wanted(False)
            first.unsubscribe("/hall/events")
            await hall.wait_until_wanted(False)


async def test_the_components_of_the_topics_that_viewers_subscribe_to_are_wanted() -> None:
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(channels("EMG 1"))
        async with viewing(port, "/lab/markers", "/lab/plates") as viewer:
            await lab.wait_until_wanted()
            assert [kind for kind in WIRE_ORDER if lab.fan_out.has_subscribers([kind])] == [MARKERS]
            for topic, kind in (("/lab/analog/cdr", ANALOG), ("/lab/forces", FORCE), ("/lab/events", EVENT)):
                viewer.subscribe(topic)
                await wait_until_async(partial(lab.fan_out.has_subscribers, [kind]))
            assert not lab.fan_out.has_subscribers([TOOLS])
            viewer.unsubscribe("/lab/markers")
            await wait_until_async(lambda: not lab.fan_out.has_subscribers([MARKERS]))
            assert lab.wanted


async def test_frames_without_anything_that_viewers_subscribe_to_do_not_count_as_sent() -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers") as viewer:
        await lab.wait_until_wanted()
        lab.publish_items(TOOLS, [pose(1, 2, 3)])
        lab.publish_items(MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers")
        [(_, status)] = lab.fan_out.outputs
        assert status.messages == {"frame": 1}


async def test_nothing_is_converted_but_what_somebody_subscribes_to(monkeypatch: pytest.MonkeyPatch) -> None:
    converted: list[str] = []
    for owner, name in (
        (messages.FoxgloveSource, "_cloud"),
        (messages.FoxgloveSource, "_transforms"),
        (float_topics.ProtobufRecord, "encode"),
        (float_topics.CdrRecord, "encode"),
        (messages.FoxgloveSource, "_log"),
        (forces.ForceScene, "arrows"),
    ):
        original = getattr(owner, name)

        def spy(*arguments: object, name: str = name, original: object = original) -> object:
            converted.append(name)
            return original(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(owner, name, spy)
    everything: dict[ComponentType, list[Any]] = {
        MARKERS: [(1, 2, 3, 0)],
        TOOLS: [pose(1, 2, 3)],
        ANALOG: [1],
        FORCE: [(0, 0, 500, 0, 0, 0)],
        EVENT: [(7, 0, 1, 2, 3)],
    }
    async with serving("lab") as (port, [lab]), viewing(port) as viewer:
        lab.set_parameters(Parameters(force=ParametersForce((PLATE,))))
        await viewer.wait_until(lambda: "/lab/loads" in viewer.topics)
        viewer.subscribe("/lab/loads")
        await lab.wait_until_wanted()
        lab.publish(frame_of(everything))
        await viewer.wait_for("/lab/loads")
        assert converted == ["encode"]
        viewer.unsubscribe("/lab/loads")
        await lab.wait_until_wanted(False)
        lab.publish(frame_of(everything))
        viewer.subscribe("/lab/forces", "/lab/events")
        await lab.wait_until_wanted()
        lab.publish(frame_of(everything))
        await viewer.wait_for("/lab/events")
        assert sorted(converted) == ["_log", "arrows", "encode"]


async def test_viewers_have_their_own_subscriptions() -> None:
    async with (
        serving("lab") as (port, [lab]),
        viewing(port, "/lab/markers", subprotocol="foxglove.websocket.v1") as first,
        viewing(port, "/lab/markers", "/lab/tools") as second,
    ):
        assert (first.subprotocol, second.subprotocol) == ("foxglove.websocket.v1", "foxglove.sdk.v1")
        await wait_until_async(lambda: lab.wanted)
        frame = frame_of({MARKERS: [(1, 2, 3, 0)], TOOLS: [pose(1, 2, 3)]})

        def both_receive() -> bool:
            lab.publish(frame)
            return bool(first.received["/lab/markers"] and second.received["/lab/tools"])

        await wait_until_async(both_receive)
        assert not first.received["/lab/tools"]


async def test_requests_that_make_no_sense_are_answered_with_an_error_and_change_nothing() -> None:
    async with serving("lab") as (port, [lab]), viewing(port) as viewer:
        markers, tools = (viewer.channel(topic)["id"] for topic in ("/lab/markers", "/lab/tools"))
        viewer.subscribe("/lab/markers")
        await lab.wait_until_wanted()
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
        assert f"channel {markers} has a subscription already" in await answer(subscribe((7, markers)))
        assert f"subscription {used} exists already" in await answer(subscribe((used, tools)))
        viewer.send({"op": "unsubscribe", "subscriptionIds": [9]})  # it may have ended with its channel
        for op in ("advertise", "getParameters", "subscribeConnectionGraph"):
            assert "only subscribe and unsubscribe" in await answer({"op": op})
        viewer.received.clear()
        lab.publish(frame_of({MARKERS: [(1, 2, 3, 0)], TOOLS: [pose(1, 2, 3)]}))
        lab.publish_items(MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers", 2)
        assert viewer.received.keys() == {"/lab/markers"}


async def test_a_subscription_to_a_channel_that_has_just_been_withdrawn_is_ignored() -> None:
    async with serving("lab") as (port, [lab]):
        lab.set_parameters(channels("EMG 1"))
        async with viewing(port) as viewer:
            withdrawn = viewer.channel("/lab/analog")["id"]
            lab.set_parameters(channels("EMG 2"), 2)
            viewer.send({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": withdrawn}]})
            viewer.subscribe("/lab/markers")
            await lab.wait_until_wanted()
            assert viewer.warnings == []


async def test_clients_of_other_protocols_are_refused() -> None:
    async with serving("lab") as (port, _):
        with pytest.raises(HandshakeRefusedError, match="400"):
            await Viewer.open(port, "chat")


# Descriptions ----------------------------------------------------------------------------------


async def test_parameters_and_plates_are_sent_to_each_viewer_that_subscribes_and_when_they_change() -> None:
    async with serving("lab") as (port, [lab]):
        described = Parameters(
            markers=Parameters3D(100.0, "mm", (Marker("1", "knee"),)), force=ParametersForce((PLATE,))
        )
        lab.set_parameters(described, 3, QUARTER_TURN)
        for _ in range(2):
            async with viewing(port, "/lab/parameters", "/lab/plates") as viewer:
                [parameters] = await viewer.wait_for("/lab/parameters")
                assert parameters.content["version"] == 3
                assert parameters.content["3d"]["labels"] == ["knee"]
                assert parameters.content["frame"] == {
                    "frame_id": "hall",
                    "metres_per_unit": 1e-3,
                    "rotation_xyzw": list(QUARTER_TURN.rotation_xyzw),
                    "translation_m": [10, 0, 0],
                }
                [plates] = await viewer.wait_for("/lab/plates")
                [entity] = plates.content.entities
                assert (entity.frame_id, entity.id) == ("hall", "left")
                corners = [(p.x, p.y) for p in entity.lines[0].points]
                assert np.allclose(corners, [(9.6, 0.6), (9.6, 0), (10, 0), (10, 0.6)])
        async with viewing(port, "/lab/parameters", "/lab/plates") as viewer:
            await viewer.wait_for("/lab/plates")
            lab.set_parameters(Parameters(), 4)
            await viewer.wait_for("/lab/plates", 2)
            assert [log.content["version"] for log in viewer.received["/lab/parameters"]] == [3, 4]
            assert not viewer.received["/lab/plates"][1].content.entities
            assert not lab.wanted


async def test_plates_are_scaled_but_have_units_of_their_own() -> None:
    """Here, the server says mm, and the settings that its positions are in m."""
    frame = CoordinateFrame("hall", metres_per_unit=2.0, scale=2.0)
    described = Parameters(markers=Parameters3D(unit="mm"), force=ParametersForce((PLATE,)))
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/plates") as viewer:
        lab.set_parameters(described, 1, frame)
        await viewer.wait_until(lambda: viewer.received["/lab/plates"][-1:] and entities(viewer))
        [entity] = entities(viewer)
        corners = [(p.x, p.y) for p in entity.lines[0].points]
        assert np.allclose(corners, [(1.2, 0.8), (0, 0.8), (0, 0), (1.2, 0)])


def entities(viewer: Viewer) -> Any:
    return viewer.received["/lab/plates"][-1].content.entities


async def test_names_of_fields_that_are_not_the_labels_can_be_queried() -> None:
    async with serving("lab") as (port, [lab]), viewing(port) as viewer:
        lab.set_parameters(channels("EMG 1", "EMG_1", "time"))
        await viewer.wait_until(lambda: "/lab/analog" in viewer.topics)
        assert lab.output.topic_names("lab") == {"analog": {"EMG 1": "EMG_1", "EMG_1": "EMG_1_2"}}
        assert lab.output.topic_names("none") == {}


# The port ------------------------------------------------------------------------------------------


async def test_a_port_that_is_taken_is_a_problem_until_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    output = FoxgloveOutput(FoxgloveSettings(enabled=True, port=port))
    with socket.create_server(("127.0.0.1", port)):
        output.start()
        await wait_until_async(lambda: "choose another foxglove.port" in output.health().problem)
        assert f"127.0.0.1:{port}" in output.health().problem
    try:
        await wait_until_async(lambda: output.health().connected)
        async with await Viewer.open(port):
            pass
    finally:
        output.close()
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1


async def test_an_output_that_is_closed_while_it_opens_releases_the_port() -> None:
    for _ in range(10):
        output = FoxgloveOutput(FoxgloveSettings(enabled=True, host="localhost", port=free_port()))
        output.start()
        await asyncio.to_thread(output.close)
        assert not output.health().connected
        with socket.create_server(("127.0.0.1", output.settings.port)):
            pass


async def test_a_defect_does_not_end_the_attempts_to_listen(monkeypatch: pytest.MonkeyPatch) -> None:
    defects = iter([KeyError("x")])
    opened = FoxgloveServer.open

    async def open_or_fail(server: FoxgloveServer) -> None:
        for defect in defects:
            raise defect
        await opened(server)

    monkeypatch.setattr(FoxgloveServer, "open", open_or_fail)
    output = FoxgloveOutput(FoxgloveSettings(enabled=True, port=free_port()))
    output.start()
    try:
        await wait_until_async(lambda: "defect in the gateway: KeyError" in output.health().problem)
        await wait_until_async(lambda: output.health().connected)
    finally:
        output.close()


async def test_an_address_of_another_computer_is_a_problem() -> None:
    output = FoxgloveOutput(FoxgloveSettings(enabled=True, host="192.0.2.1", port=free_port()))
    output.start()
    try:
        await wait_until_async(lambda: "correct foxglove.host" in output.health().problem)
    finally:
        output.close()
    assert not output.health().connected
