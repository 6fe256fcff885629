"""The gateway as an RT server, and RTC3D clients that are sockets with a thread each."""

import contextlib
import math
import socket
import struct
import threading
from typing import ClassVar, Final

from gateway.outputs.adapters.rtc3d.output import Rtc3dOutput
from gateway.outputs.adapters.rtc3d.settings import Rtc3dSettings
from gateway.outputs.contract import Output
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from tests.contract.frame_rigs import HALL, LAB, ListeningRig
from tests.support.networks import free_port
from tests.support.waiting import wait_until
from tests.unit.session.server.wire import DATA, command

HEADER: Final = struct.Struct(">II")


class Rig(ListeningRig):
    """Clients of both ports. They get what the server sent, in its unit: the tests send mm."""

    remedies: ClassVar[tuple[str, ...]] = ("rtc3d.ports",)
    converts: ClassVar[bool] = False

    def __init__(self) -> None:
        self._ports = {LAB: free_port(), HALL: free_port()}
        super().__init__(self._ports[LAB])

    def create(self) -> Output:
        return Rtc3dOutput(Rtc3dSettings(enabled=True, ports=self._ports))

    def subscribe(self) -> None:
        for source in self._ports:
            threading.Thread(target=self._read, args=(source, self._connect(source)), daemon=True).start()

    def _connect(self, source: str) -> socket.socket:
        client = self._connection(self._ports[source])
        self.clients.append(client)
        client.sendall(command("SetByteOrder BigEndian") + command("StreamFrames AllFrames"))
        return client

    @staticmethod
    def _connection(port: int) -> socket.socket:
        """Connect, as soon as the port is open again."""
        found: list[socket.socket] = []

        def connects() -> bool:
            with contextlib.suppress(ConnectionRefusedError):
                found.append(socket.create_connection(("127.0.0.1", port)))
            return bool(found)

        wait_until(connects)
        return found[0]

    def _read(self, source: str, client: socket.socket) -> None:
        with contextlib.suppress(OSError):
            stream = client.makefile("rb")
            while header := stream.read(HEADER.size):
                size, packet_type = HEADER.unpack(header)
                body = stream.read(size - HEADER.size)
                for component in split_frame(body, "big").components if packet_type == DATA else ():
                    if component.type is ComponentType.TOOLS:
                        xs = component.items()["x"].tolist()
                        self._received += [(source, x / 1000) for x in xs if not math.isnan(x)]

    def stall(self) -> None:
        for source in self._ports:
            self._connect(source)
