"""What a browser says to viser and receives from it, without a browser."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import msgspec
import viser
import zstandard
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

_CAMERA: Final = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 3.0, 3.0),
    "fov": 1.3,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 400,
    "image_width": 600,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class PageClient:
    """A page that is connected; viser counts it after its first camera message."""

    def __init__(self, connection: Connection, camera: dict[str, Any]) -> None:
        self._connection = connection
        self.send({**_CAMERA, **camera})

    def send(self, message: dict[str, Any]) -> None:
        """Send a message."""
        self._connection.send(msgspec.msgpack.encode(message))

    def receive(self) -> list[dict[str, Any]]:
        """Return the messages of the next window; arrays are placeholders. Wait at most 10 s."""
        data = self._connection.recv(timeout=10)
        assert isinstance(data, bytes)
        size = int.from_bytes(data[8:16], "little")
        decompressed = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
        messages: list[dict[str, Any]] = msgspec.msgpack.decode(decompressed)["messages"]
        return messages

    def wait_for(self, name: str, update: str) -> None:
        """Read until a property of this node is changed."""
        while not any(
            message.get("name") == name and update in message.get("updates", ()) for message in self.receive()
        ):
            pass


@contextmanager
def page_client(
    server: viser.ViserServer, origin: Origin | None = None, **camera: Any
) -> Iterator[PageClient]:
    """Connect a page, and provide it. ``camera`` replaces fields of its camera message."""
    url = f"ws://127.0.0.1:{server.get_port()}"
    protocol: Any = f"viser-v{viser.__version__}"
    with connect(url, subprotocols=[protocol], origin=origin, max_size=None, close_timeout=0.1) as connection:
        yield PageClient(connection, camera)
