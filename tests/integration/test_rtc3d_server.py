"""The RT server as a library: any scene, and a filter between its connections and their sockets."""

import asyncio
import logging

import pytest

from gateway.rtc3d.packets import Packet
from gateway.rtc3d_server.client_session import error_packet
from gateway.rtc3d_server.connection_filter import ConnectionFilter, FilteredConnection
from gateway.rtc3d_server.server import RtServer
from tests.integration.raw_client import connected, until
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, DATA, ERROR, command


class RefusingFilter(ConnectionFilter):
    """Refuses SetByteOrder, drops every other data frame and writes a last text."""

    def __init__(self, connection: FilteredConnection) -> None:
        super().__init__(connection)
        self.received = b""
        self.num_frames = 0
        self.is_lost = False

    def send(self, packet: bytes) -> None:
        is_frame = packet[7] == DATA
        self.num_frames += is_frame
        if not (is_frame and self.num_frames % 2):
            super().send(packet)

    def receive(self, data: bytes) -> None:
        self.received += data
        super().receive(data)

    def answer(self, packet: Packet) -> list[bytes]:
        if packet.body.startswith(b"SetByteOrder"):
            return [error_packet("not here")]
        return super().answer(packet)

    def flush(self) -> None:
        self.connection.write(b"the end")

    def connection_lost(self) -> None:
        self.is_lost = True


async def test_names_of_clients_have_brackets_if_the_address_is_one_of_ipv6(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    async with RtServer(CountingScene(), host="::1") as server:
        reader, writer = await asyncio.open_connection("::1", server.port)
        writer.write(command("Bye"))
        await reader.read()
        writer.close()
        port = writer.get_extra_info("sockname")[1]
        await until(lambda: f"[::1]:{port}: disconnected" in caplog.text)


async def test_a_filter_can_change_all_bytes_of_a_connection() -> None:
    filters: list[RefusingFilter] = []

    def new_filter(connection: FilteredConnection) -> ConnectionFilter:
        filters.append(RefusingFilter(connection))
        return filters[-1]

    async with (
        RtServer(CountingScene(1000.0), new_filter=new_filter, name="Lab") as server,
        connected(server) as client,
    ):
        assert b"Lab" in (await client.ask("SendParameters General"))[1]
        assert await client.ask("SetByteOrder LittleEndian") == (ERROR, b"Error-not here")
        assert await client.ask("StreamFrames 3D") == (COMMAND, b"OK-StreamFrames 3D")
        numbers = [frame[0].frame_number for frame in await client.frames(10)]
        assert numbers == list(range(numbers[0], numbers[0] + 20, 2))
        client.send(command("Bye"))
        assert (await client.rest()).endswith(b"bye" + b"the end")
        [connection_filter] = filters
        assert connection_filter.connection.number == 1
        assert connection_filter.received.endswith(command("Bye"))
        await until(lambda: connection_filter.is_lost)
