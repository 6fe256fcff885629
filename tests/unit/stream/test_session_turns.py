"""A session that is flooded: it processes what arrives in turns with others, and reads no more meanwhile."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import DefectError
from gateway.rtc3d.commands import StreamFrames, Version
from gateway.rtc3d.frames import Frame
from gateway.stream.files import IgnoredFiles
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from tests.losses import amounts
from tests.servers import markers_frame, packet
from tests.unit.stream.scripted_server import ScriptedServer
from tests.virtual_time import read_clocks, settle

STEP_S = 0.0005
"""How much time passes from one reading of the clock to the next, as if the work between them took it."""


class Lab:
    """A flooded session. ``frames`` are the number and the time of arrival, in µs, of those published."""

    def __init__(self, **stream: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.frames: list[tuple[int, int]] = []
        self.turns = 0
        self.readings = 0
        self.session = Session(
            SourceSettings(name="lab", host="192.0.2.20"),
            StreamSettings.model_validate({"components": ["3d"], **stream}),
            self.status,
            self._on_frames,
            IgnoredFiles(),
            self.server.connect,
            self._read_clocks,
        )

    def _on_frames(self, frames: list[Frame], _utime: int, steady_us: int) -> None:
        self.frames += [(frame.components[0].frame_number, steady_us) for frame in frames]

    def _read_clocks(self) -> tuple[int, int]:
        self.readings += 1
        utime, steady_us = read_clocks()
        passed_us = round(1e6 * STEP_S * self.readings)
        return utime + passed_us, steady_us + passed_us

    @property
    def rejected(self) -> int:
        return amounts(self.status.losses.report()).get("frame rejected", (0, 0))[1]

    async def stream(self) -> None:
        await self.session.connect()
        await self.session.ask(StreamFrames())

    def send(self, data: bytes) -> None:
        self.server.connection.send(data)

    async def count_turns(self, is_done: Callable[[], bool]) -> int:
        """Return how many turns other callbacks had until ``is_done``."""
        turns = 0
        while not is_done():
            assert turns < 10_000
            turns += 1
            await asyncio.sleep(0)
        return turns


@pytest.fixture
async def lab() -> Lab:
    lab = Lab()
    await lab.stream()
    return lab


REJECTED = packet(3, b"\0")


async def test_a_read_of_tiny_packets_is_processed_in_turns_with_others(lab: Lab) -> None:
    lab.send(REJECTED * 10_000)
    assert 64 <= lab.rejected <= 6 * 64
    assert not lab.server.connection.is_read
    assert await lab.count_turns(lambda: lab.server.connection.is_read) > 10_000 / 64 / 6
    assert lab.rejected == 10_000


async def test_a_long_read_gives_others_their_turn_although_it_is_quickly_processed(lab: Lab) -> None:
    lab.send(packet(99, bytes(100_000)))
    assert not lab.server.connection.is_read
    await settle()
    assert lab.server.connection.is_read


async def test_an_ordinary_read_does_not_pause_anything(lab: Lab) -> None:
    lab.send(markers_frame(1, *[(0.0, 0.0, 0.0)] * 1000))
    assert lab.server.connection.is_read
    assert [number for number, _ in lab.frames] == [1]


@pytest.mark.parametrize("backlog", ["all", "latest"])
async def test_frames_keep_their_order_and_their_time_of_arrival(backlog: str) -> None:
    lab = Lab(backlog=backlog)
    await lab.stream()
    lab.send(
        b"".join(packet(4) + REJECTED + markers_frame(number, (0.0, 0.0, 0.0)) for number in range(5000))
    )
    assert 0 < len(lab.frames) < 5000
    await lab.count_turns(lambda: lab.server.connection.is_read)
    assert [number for number, _ in lab.frames] == list(range(5000))
    assert len({arrived_us for _, arrived_us in lab.frames}) == 1
    assert lab.rejected == 5000


async def test_what_arrives_during_a_read_waits_behind_it(lab: Lab) -> None:
    """A transport may pass on what it had read before it was paused."""
    lab.send(b"".join(markers_frame(number, (0.0, 0.0, 0.0)) for number in range(3000)))
    lab.send(b"".join(markers_frame(number, (0.0, 0.0, 0.0)) for number in range(3000, 6000)))
    await lab.count_turns(lambda: lab.server.connection.is_read)
    assert [number for number, _ in lab.frames] == list(range(6000))


async def test_a_packet_that_is_split_within_a_flood_is_read(lab: Lab) -> None:
    data = b"".join(markers_frame(number, (0.0, 0.0, 0.0)) for number in range(3000))
    for start in range(0, len(data), 20_001):
        lab.send(data[start : start + 20_001])
        await lab.count_turns(lambda: lab.server.connection.is_read)
    assert [number for number, _ in lab.frames] == list(range(3000))


async def test_closing_publishes_what_has_arrived_before_it_returns(lab: Lab) -> None:
    lab.send(b"".join(REJECTED + markers_frame(number, (0.0, 0.0, 0.0)) for number in range(5000)))
    assert len(lab.frames) < 5000
    await lab.session.close()
    assert [number for number, _ in lab.frames] == list(range(5000))


async def test_a_connection_that_breaks_is_processed_to_its_end(lab: Lab) -> None:
    lab.send(b"".join(REJECTED + markers_frame(number, (0.0, 0.0, 0.0)) for number in range(5000)))
    lab.server.connection.end(OSError("broken"))
    await asyncio.sleep(0)
    assert len(lab.frames) < 5000
    await lab.session.close()
    assert [number for number, _ in lab.frames] == list(range(5000))


async def test_a_defect_during_a_flood_ends_the_session(lab: Lab) -> None:
    lab.send(b"".join(markers_frame(number, (0.0, 0.0, 0.0)) for number in range(5000)))
    del lab.frames
    await lab.count_turns(lambda: not lab.server.connection.is_open)
    with pytest.raises(DefectError, match="AttributeError"):
        await lab.session.ask(Version())
    await lab.session.close()


async def test_a_reply_behind_a_flood_is_found(lab: Lab) -> None:
    asking = asyncio.create_task(lab.session.ask(Version()))
    lab.server.answer = lambda _: None
    await asyncio.sleep(0)
    lab.send(REJECTED * 10_000 + packet(1, b"OK-Version 1.0"))
    assert (await asking).body == b"OK-Version 1.0"
