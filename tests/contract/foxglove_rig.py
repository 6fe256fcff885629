"""The output for viewers, with viewers that speak its protocol by hand."""

import asyncio
import json
import socket
import threading
from typing import Any

from gateway.outputs.adapters.foxglove.output import FoxgloveOutput
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.contract import Output
from tests.contract.frame_rigs import SOURCES, ListeningRig
from tests.support.foxglove_viewer import Viewer, client_frame, upgrade_request
from tests.support.networks import free_port

TOPICS = tuple(f"/{source}/tools" for source in SOURCES)


class Rig(ListeningRig):
    remedies = ("choose another foxglove.port",)

    def __init__(self) -> None:
        self._port = free_port()
        super().__init__(self._port)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._viewers: list[Viewer] = []

    def create(self) -> Output:
        return FoxgloveOutput(FoxgloveSettings(enabled=True, port=self._port))

    def _receive(self, topic: str, transforms: Any) -> None:
        assert topic in TOPICS
        for transform in transforms.transforms:
            source, _, _label = transform.child_frame_id.partition("/")
            self._received.append((source, transform.translation.x))

    def _run(self, coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(20)

    def subscribe(self) -> None:
        self._run(self._subscribe())

    async def _subscribe(self) -> None:
        viewer = await Viewer.open(self._port)
        viewer.on_message = self._receive
        await viewer.__aenter__()
        for topic in TOPICS:
            if topic in viewer.topics:
                viewer.subscribe(topic)
        self._viewers.append(viewer)

    def unsubscribe(self) -> None:
        super().unsubscribe()
        while self._viewers:
            self._run(self._viewers.pop().__aexit__(None, None, None))

    def stall(self) -> None:
        connection = socket.create_connection(("127.0.0.1", self._port))
        connection.sendall(upgrade_request(b"AAAAAAAAAAAAAAAAAAAAAA==", "foxglove.sdk.v1"))
        wanted = [{"id": number, "channelId": number} for number in range(100)]
        connection.sendall(client_frame(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()))
        self.clients.append(connection)

    def close(self) -> None:
        super().close()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
