"""A session whose frames arrive faster than they were measured, or than others can wait: pace and turns."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from gateway.errors import DefectError, ReplyTimeoutError, SilenceError
from gateway.rtc3d.commands import Version
from tests.support.clocks import settle, until
from tests.support.servers import markers_frame, packet
from tests.support.statuses import amounts
from tests.unit.session.scripted_server import silent_to
from tests.unit.session.session_lab import Lab, now_s

REJECTED = packet(3, b"\0")


def frames(count: int, before_each: bytes = b"", first: int = 0) -> bytes:
    return b"".join(
        before_each + markers_frame(number, (0.0, 0.0, 0.0)) for number in range(first, first + count)
    )


# --- the pace of a backlog


async def backlog(count: int = 2000, lab: Lab | None = None) -> Lab:
    """Stream with a clock, and let ``count`` frames, 1 ms apart, arrive together."""
    lab = lab or Lab()
    lab.status.clock.has_clock = True
    await lab.streaming(*range(count))
    return lab


@pytest.mark.parametrize(("settings", "takes_s"), [({}, 1.0), ({"backlog_speed": 10.0}, 0.2)])
async def test_a_backlog_is_published_at_its_speed_while_nothing_is_read(
    settings: dict[str, Any], takes_s: float
) -> None:
    began_s = now_s()
    lab = await backlog(lab=Lab(**settings))
    assert len(lab.frames) < 50
    assert not lab.connection.is_read
    await until(lambda: lab.connection.is_read)
    assert lab.numbers == list(range(2000))
    assert now_s() - began_s == pytest.approx(takes_s, abs=0.05)
    assert {arrived_s for _, arrived_s in lab.frames} == {began_s}, "the time of arrival is that of the read"


async def test_latest_takes_a_batch_whole() -> None:
    lab = await backlog(lab=Lab(backlog="latest"))
    assert lab.numbers == list(range(2000))


async def test_a_reply_behind_a_backlog_is_waited_for_and_times_out_only_after_it() -> None:
    lab = await backlog(6000, Lab(silent_to("Version")))
    asked_s = now_s()
    asking = asyncio.create_task(lab.session.ask(Version()))
    await until(lambda: lab.connection.is_read)
    assert now_s() - asked_s > 2.5, "longer than reply_timeout_s"
    await asyncio.sleep(1.5)
    lab.connection.send(packet(1, "OK-Version"))
    assert (await asking).body == b"OK-Version"

    lab = await backlog(6000, Lab(silent_to("Version")))
    asked_s = now_s()
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(Version())
    assert now_s() - asked_s == pytest.approx(3 + 2, abs=0.2)


async def test_a_backlog_is_not_silence() -> None:
    lab = await backlog(10_000)
    began_s = now_s()
    with pytest.raises(SilenceError):
        await lab.session.monitor(lab.check_silence)
    assert now_s() - began_s == pytest.approx(5 + 3, abs=0.2)
    assert (len(lab.frames), lab.checks_s) == (10_000, [])


@pytest.mark.parametrize("breaks", [False, True])
async def test_the_end_of_the_session_publishes_what_waits(*, breaks: bool) -> None:
    lab = await backlog()
    if breaks:
        lab.connection.end(OSError("broken"))
        await settle()
    else:
        await lab.session.close()
    assert (lab.numbers, lab.connection.is_open) == (list(range(2000)), False)


@pytest.mark.parametrize("has_clock", [True, False], ids=["backlog", "flood"])
async def test_a_defect_in_publishing_ends_the_session(*, has_clock: bool) -> None:
    lab = await backlog() if has_clock else await flooded()
    lab.connection.send(frames(5000))
    del lab.frames
    await until(lambda: not lab.connection.is_open)
    with pytest.raises(DefectError, match="AttributeError"):
        await lab.session.ask(Version())
    await lab.session.close()


# --- turns with others during a flood, while nothing more is read


async def flooded(data: bytes = b"", backlog: str = "all") -> Lab:
    lab = Lab(backlog=backlog, step_s=0.0005)
    await lab.streaming()
    lab.connection.send(data)
    return lab


def num_rejected(lab: Lab) -> int:
    return amounts(lab.status.losses.report()).get("frame rejected", (0, 0))[1]


async def count_turns(is_done: Callable[[], bool]) -> int:
    """Return how many turns other callbacks had until ``is_done``."""
    turns = 0
    while not is_done():
        assert turns < 10_000
        turns += 1
        await asyncio.sleep(0)
    return turns


async def test_a_read_of_tiny_packets_is_processed_in_turns_with_others() -> None:
    lab = await flooded(REJECTED * 10_000)
    assert 64 <= num_rejected(lab) <= 6 * 64
    assert not lab.connection.is_read
    assert await count_turns(lambda: lab.connection.is_read) > 10_000 / 64 / 6
    assert num_rejected(lab) == 10_000


async def test_a_long_read_gives_others_their_turn_although_it_is_quickly_processed() -> None:
    lab = await flooded(packet(99, bytes(100_000)))
    assert not lab.connection.is_read
    await settle()
    assert lab.connection.is_read


async def test_an_ordinary_read_does_not_pause_anything() -> None:
    lab = await flooded(markers_frame(1, *[(0.0, 0.0, 0.0)] * 1000))
    assert (lab.numbers, lab.connection.is_read) == ([1], True)


@pytest.mark.parametrize("backlog", ["all", "latest"])
async def test_frames_keep_their_order_and_their_time_of_arrival(backlog: str) -> None:
    lab = await flooded(frames(5000, packet(4) + REJECTED), backlog)
    assert 0 < len(lab.frames) < 5000
    await count_turns(lambda: lab.connection.is_read)
    assert lab.numbers == list(range(5000))
    assert len({arrived_s for _, arrived_s in lab.frames}) == 1
    assert num_rejected(lab) == 5000


async def test_what_arrives_during_a_read_waits_behind_it() -> None:
    """A transport may pass on what it had read before it was paused."""
    lab = await flooded(frames(3000))
    lab.connection.send(frames(3000, first=3000))
    await count_turns(lambda: lab.connection.is_read)
    assert lab.numbers == list(range(6000))


async def test_a_packet_that_is_split_within_a_flood_is_read() -> None:
    data, lab = frames(3000), await flooded()
    for start in range(0, len(data), 20_001):
        lab.connection.send(data[start : start + 20_001])
        await count_turns(lambda: lab.connection.is_read)
    assert lab.numbers == list(range(3000))


@pytest.mark.parametrize("breaks", [False, True])
async def test_closing_publishes_what_has_arrived_before_it_returns(*, breaks: bool) -> None:
    lab = await flooded(frames(5000, REJECTED))
    if breaks:
        lab.connection.end(OSError("broken"))
        await asyncio.sleep(0)
    assert len(lab.frames) < 5000
    await lab.session.close()
    assert lab.numbers == list(range(5000))


async def test_a_reply_behind_a_flood_is_found() -> None:
    lab = await flooded()
    lab.server.answer = silent_to("")
    asking = asyncio.create_task(lab.session.ask(Version()))
    await asyncio.sleep(0)
    lab.connection.send(REJECTED * 10_000 + packet(1, b"OK-Version 1.0"))
    assert (await asking).body == b"OK-Version 1.0"
