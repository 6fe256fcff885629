"""The VRPN output, and clients that are sockets with a thread each."""

import contextlib
import socket
import struct
import threading
from typing import ClassVar, Final

from gateway.outputs.adapters.vrpn.output import VrpnOutput
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from gateway.outputs.contract import Output
from tests.contract.frame_rigs import ListeningRig
from tests.support.networks import free_port
from tests.support.vrpn_client import COOKIE

HEADER: Final = struct.Struct(">IIIiiI")
BODY: Final = struct.Struct(">ii7d")


class Rig(ListeningRig):
    """Clients that connect over TCP. With several sources, a tracker is called SOURCE/TOOL."""

    remedies: ClassVar[tuple[str, ...]] = ("stop the program that uses the port",)

    def __init__(self) -> None:
        self._port = self.udp_port = free_port()
        super().__init__(self._port)

    def create(self) -> Output:
        return VrpnOutput(VrpnSettings(enabled=True, port=self._port, tracker_names="source/tool"))

    def subscribe(self) -> None:
        threading.Thread(target=self._read, args=(self._connect(),), daemon=True).start()

    def _connect(self) -> socket.socket:
        client = socket.create_connection(("127.0.0.1", self._port))
        self.clients.append(client)
        client.sendall(COOKIE)
        return client

    def _read(self, client: socket.socket) -> None:
        names: dict[int, str] = {}
        with contextlib.suppress(OSError, EOFError):
            stream = client.makefile("rb")
            assert stream.read(24) == COOKIE
            while header := stream.read(HEADER.size):
                length, _, _, number, message_type, _ = HEADER.unpack(header)
                body = stream.read(-(-(length - 24) // 8) * 8)
                if message_type == -1:
                    names[number] = body[4:].partition(b"\0")[0].decode()
                elif message_type == 0:
                    self._received.append((names[number].partition("/")[0], BODY.unpack(body)[2]))

    def stall(self) -> None:
        self._connect()
