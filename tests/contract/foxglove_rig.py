"""The output for viewers, with viewers that speak its protocol by hand."""

import asyncio
import json
import socket
import threading
from typing import Any

from gateway.outputs.contract import Output
from gateway.outputs.foxglove.output import FoxgloveOutput
from gateway.outputs.foxglove.settings import FoxgloveSettings
from tests.contract.frame_rigs import SOURCES, FrameRig, Received
from tests.foxglove_viewer import Viewer, client_frame, upgrade_request
from tests.networks import free_port

TOPICS = tuple(f"/{source}/tools" for source in SOURCES)


class Rig(FrameRig):
    remedies = ("choose another foxglove.port",)
    listens = True

    def __init__(self) -> None:
        self._port = self.tcp_port = free_port()
        self.output = self.create()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._viewers: list[Viewer] = []
        self._received: list[Received] = []
        self._stalled: list[socket.socket] = []
        self._other_program: socket.socket | None = None

    def create(self) -> Output:
        return FoxgloveOutput(FoxgloveSettings(enabled=True, port=self._port))

    @property
    def received(self) -> list[Received]:
        return self._received

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
        while self._viewers:
            self._run(self._viewers.pop().__aexit__(None, None, None))

    def stall(self) -> None:
        connection = socket.create_connection(("127.0.0.1", self._port))
        connection.sendall(upgrade_request(b"AAAAAAAAAAAAAAAAAAAAAA==", "foxglove.sdk.v1"))
        wanted = [{"id": number, "channelId": number} for number in range(100)]
        connection.sendall(client_frame(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()))
        self._stalled.append(connection)

    def cut(self) -> None:
        self._other_program = socket.create_server(("127.0.0.1", self._port))

    def restore(self) -> None:
        assert self._other_program is not None
        self._other_program.close()

    def close(self) -> None:
        self.unsubscribe()
        for connection in (*self._stalled, *([self._other_program] if self._other_program else [])):
            connection.close()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
