"""The server of foxglove-sdk advertises and sends the same topics and messages in the same way."""

import asyncio
from collections.abc import Callable
from typing import Any

import foxglove

from gateway.messages.foxglove.messages import FoxgloveSource
from gateway.messages.foxglove.topics import FloatTopics, FoxgloveMessage
from gateway.outputs.adapters.foxglove.server import FoxgloveServer, send
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.rtc3d.parameters import Parameters
from tests.support.foxglove_viewer import Received, Viewer
from tests.support.networks import free_port
from tests.unit.outputs.adapters.foxglove.live import UTIME, channels, frame_of


def messages(parameters: Parameters) -> list[FoxgloveMessage]:
    """Return a message of each kind of topic."""
    source = FoxgloveSource(FloatTopics("lab", is_live=True), parameters, 1)
    frame = frame_of({ComponentType.MARKERS: [(1, 2, 3, 0)], ComponentType.ANALOG: [1, 2]})
    found = source.describe(UTIME)
    for component in frame.components:
        items = component.items().astype(ITEM_DTYPES[component.type])
        for each in source.convert_frames(component.type, items[None], [UTIME], [0]):
            found.append(FoxgloveMessage(each.topic, each.utimes[0], each.messages[0]))
    return found


async def watch(
    port: int, sent: list[FoxgloveMessage], send_all: Callable[[], None]
) -> tuple[list[Any], dict[str, Any]]:
    """Return the advertised channels without their numbers, and what is received of each."""
    async with await Viewer.open(port) as viewer:
        await viewer.wait_until(lambda: len(viewer.channels) == len(sent))
        viewer.subscribe(*viewer.topics)
        received: dict[str, list[Received]] = viewer.received
        while len(received) < len(sent):
            send_all()
            await asyncio.sleep(0.01)
        advertised = [{**channel, "id": None} for channel in viewer.channels.values()]
        return sorted(advertised, key=lambda channel: channel["topic"]), {
            topic: (logs[0].time_ns, logs[0].data, str(logs[0].content)) for topic, logs in received.items()
        }


async def test_a_viewer_finds_the_same_on_both_servers() -> None:
    sent = messages(channels("EMG 1", "EMG 2"))
    assert {message.topic.encoding for message in sent} == {"json", "protobuf", "cdr"}

    server = FoxgloveServer("127.0.0.1", port := free_port(), "1")
    await server.open()
    opened = [(server.open_channel(message.topic, lambda _: None), message) for message in sent]

    def send_own() -> None:
        for channel, each in opened:
            send(channel, each.utime, each.data)

    try:
        own = await watch(port, sent, send_own)
    finally:
        await server.close()

    context = foxglove.Context()
    reference = foxglove.start_server(host="127.0.0.1", port=0, context=context)
    logged = []
    for each in sent:
        name, encoding, schema_name, schema_encoding, data = each.topic
        schema = foxglove.Schema(name=schema_name, encoding=schema_encoding, data=data)
        channel = foxglove.Channel(name, schema=schema, message_encoding=encoding, context=context)
        logged.append((channel, each))

    def send_theirs() -> None:
        for channel, each in logged:
            channel.log(each.data, log_time=each.utime * 1000)

    try:
        theirs = await watch(reference.port, sent, send_theirs)
    finally:
        reference.stop()
    assert own == theirs
