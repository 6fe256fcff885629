"""A scripted RT server with 6D tools whose poses, labels and visibility tests set."""

import asyncio
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gateway.rtc3d.components import ITEM_DTYPES, MISSING, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame
from gateway.rtc3d.parameters import Parameters, Parameters3D, Parameters6D, Tool
from gateway.rtc3d.parameters_xml import encode_parameters
from tests.servers import Client, ScriptedServer, ok, packet

PERIOD_S = 0.01


class ToolServer(ScriptedServer):
    """Sends frames of its ``tools`` at 100 Hz: (q0, qx, qy, qz, x, y, z, error) each, None if out of view."""

    def __init__(self, labels: Sequence[str], unit: str = "mm") -> None:
        super().__init__(self._run)
        self.labels = list(labels)
        self.unit = unit
        self.tools: list[Sequence[float] | None] = [
            (1.0, 0.0, 0.0, 0.0, 1000.0 * number, 500.0, -250.0, 0.5) for number in range(len(labels))
        ]

    @property
    def xml(self) -> bytes:
        parameters = Parameters(
            markers=Parameters3D(100.0, self.unit),
            tools=Parameters6D(100.0, tuple(Tool(str(id_), label) for id_, label in enumerate(self.labels))),
        )
        return encode_parameters(parameters)

    async def _run(self, client: Client) -> None:
        sending: list[asyncio.Task[None]] = []

        def answer(command: str) -> bytes:
            if command.startswith("SendParameters"):
                return packet(2, self.xml)
            if command.startswith("StreamFrames") and command != "StreamFrames Stop":
                sending.append(asyncio.create_task(self._send_frames(client)))
            return ok(f"OK-{command}")

        try:
            await client.commands(answer)
        finally:
            for task in sending:
                task.cancel()

    async def _send_frames(self, client: Client) -> None:
        started_s = time.monotonic()
        number = 0
        while True:
            await asyncio.sleep(max(0.0, started_s + number * PERIOD_S - time.monotonic()))
            number += 1
            client.send(packet(3, self._frame(number)))
            await client.drain()

    def _frame(self, number: int) -> bytes:
        items: Any = np.empty(len(self.tools), ITEM_DTYPES[ComponentType.TOOLS])
        for index, tool in enumerate(self.tools):
            items[index] = (MISSING,) * 8 if tool is None else tuple(tool)
        time_us = round(number * PERIOD_S * 1e6)
        return encode_frame([encode_component(ComponentType.TOOLS, number, time_us, items)])
