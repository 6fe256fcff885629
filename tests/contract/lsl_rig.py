"""The output for LSL, with pylsl's inlets in another process."""

import math
import re
import socket
import tempfile
from pathlib import Path
from typing import ClassVar, Final

from gateway.outputs.adapters.lsl.output import LslOutput
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.contract import Output
from tests.contract.frame_rigs import SOURCES, FrameRig, Received
from tests.contract.memory_lsl import MemoryRig
from tests.support.lsl_receiver import LslReceiver, lsl_config

_PER_TOOL: Final = 8
_REQUEST: Final = (
    b"LSL:streamfeed/110 \r\nNative-Byte-Order: 1234\r\nMax-Buffer-Length: 1000000000\r\n"
    b"Max-Chunk-Length: 0\r\nProtocol-Version: 110\r\n\r\n"
)


class Rig(FrameRig):
    """LSL on this computer, apart from all other programs that use it."""

    light: ClassVar[type[FrameRig]] = MemoryRig

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._config = lsl_config(Path(self._folder.name))
        self._receivers: list[LslReceiver] = []
        self._former: list[Received] = []
        self._stalled: list[socket.socket] = []
        self.output = self.create()

    def create(self) -> Output:
        return LslOutput(LslSettings(enabled=True, config=str(self._config)))

    @property
    def received(self) -> list[Received]:
        found = list(self._former)
        for receiver in self._receivers:
            found += _positions(receiver)
        return found

    def subscribe(self) -> None:
        self._receivers.append(LslReceiver(self._config, *(f"{source}_6d" for source in SOURCES)))

    def unsubscribe(self) -> None:
        while self._receivers:
            receiver = self._receivers.pop()
            receiver.close()
            self._former += _positions(receiver)

    def stall(self) -> None:
        ports = [
            int(port)
            for receiver in self._receivers
            for xml in receiver.xml.values()
            for port in re.findall("<v4data_port>([0-9]+)", xml)
        ]
        for port in ports:
            connection = socket.create_connection(("127.0.0.1", port))
            connection.sendall(_REQUEST)
            self._stalled.append(connection)

    def close(self) -> None:
        self.unsubscribe()
        for connection in self._stalled:
            connection.close()
        self._folder.cleanup()


def _positions(receiver: LslReceiver) -> list[Received]:
    """Return x of each tool in view, in m."""
    return [
        (source, x)
        for source in SOURCES
        for _, values in list(receiver.samples[f"{source}_6d"])
        for x in values[::_PER_TOOL]
        if not math.isnan(x)
    ]
