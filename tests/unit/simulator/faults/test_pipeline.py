"""Faults at work on one connection: which packets a client gets, when, and how often a fault happens."""

import asyncio
import logging
import struct
from itertools import pairwise

import pytest

from gateway.simulator.fault_pipeline import MAX_WAITING_BYTES
from gateway.simulator.faults import (
    Delay,
    Fault,
    Garbage,
    HalfOpen,
    Jitter,
    Merge,
    NoMeasurement,
    SlowReader,
    Split,
    Undersize,
)
from gateway.simulator.packet_faults import (
    ConstantFrameNumbers,
    DoubledAcknowledgements,
    FramesFirst,
    LateAcknowledgements,
    MinimalServer,
    MissingAcknowledgements,
    RefusedCommands,
    ReplyText,
    ShortEvents,
)
from tests.support.errors import names
from tests.unit.session.server.wire import COMMAND, DATA, ERROR, EVENT, NO_DATA, XML, components_in, packet
from tests.unit.simulator.faults.faulty_client import VERSION, FaultyClient

UNDERSIZE = struct.pack(">II", 0, DATA)

# Replies --------------------------------------------------------------------------------------

GREETING = "Version 1.0"
LITTLE = (COMMAND, b"OK-SetByteOrder LittleEndian")
UNKNOWN = b"Unknown command 'Fly'"


@pytest.mark.parametrize(
    ("fault", "sent", "expected"),
    [
        (RefusedCommands(times=1), [GREETING] * 2, [(ERROR, b"Error-version is refused"), VERSION]),
        (MinimalServer(), [GREETING], [(ERROR, b"Error-version is not known in this form")]),
        (MissingAcknowledgements(commands=("version",)), [GREETING, "SetByteOrder LittleEndian"], [LITTLE]),
        (MissingAcknowledgements(), ["Version 2.0"], [(ERROR, b"Error-Version 2.0 is not supported")]),
        (
            DoubledAcknowledgements(copies=3),
            [GREETING, "Fly"],
            [VERSION] * 3 + [(ERROR, b"Error-" + UNKNOWN)],
        ),
        (DoubledAcknowledgements(times=1), [GREETING] * 2, [VERSION] * 3),
        (ReplyText(form="echo"), [GREETING, "Fly"], [(COMMAND, b"Version 1.0"), (ERROR, b"err-" + UNKNOWN)]),
        (ReplyText(form="ok-verb"), ["Version 1.0"], [(COMMAND, b"ok-version")]),
        (ReplyText(), ["SendParameters", "Bye"], [(XML, b"<RT_Parameters"), (COMMAND, b"bye")]),
        (ReplyText(connection=2), ["Version 1.0"], [VERSION]),
        (FramesFirst(), ["StreamFrames Stop"], [(COMMAND, b"OK-StreamFrames Stop")]),
    ],
    ids=str,
)
async def test_faults_of_replies(
    client: FaultyClient, fault: Fault, sent: list[str], expected: list[tuple[int, bytes]]
) -> None:
    """Each fault changes the replies that it names, leaves the others alone, and can be ended."""
    [active] = client.begin(fault)
    packets = client.ask(*sent)
    assert [kind for kind, _ in packets] == [kind for kind, _ in expected]
    for (_, found), (_, start) in zip(packets, expected, strict=True):
        assert found.startswith(start)
    client.faults.end(active)
    assert client.ask("Version 1.0") == [VERSION]


async def test_late_acknowledgements_are_overtaken_by_everything_else(client: FaultyClient) -> None:
    """Field note 3: clients must not take the next reply for the missing one."""
    client.begin(LateAcknowledgements(delay_ms=200, times=2))
    client.ask("Version 1.0", "StreamFrames 3D", "SendParameters", "SetByteOrder BigEndian")
    client.stream_until(1_000)
    await asyncio.sleep(1)
    kinds = [(kind, body[:3]) for kind, body in client.packets if kind != DATA]
    assert kinds == [(XML, b"<RT"), (COMMAND, b"OK-"), (COMMAND, b"OK-"), (COMMAND, b"OK-")]
    assert [time_s for time_s, _ in client.writes] == [0, 0, 0, 0, 0.2, 0.2]
    assert client.packets[-2:] == [VERSION, (COMMAND, b"OK-StreamFrames 3D")]


async def test_frames_or_no_data_come_before_the_acknowledgement(client: FaultyClient) -> None:
    """Field note 3: a request counts as accepted before its acknowledgement."""
    client.begin(FramesFirst(frames=3))
    client.ask("StreamFrames 3D")
    client.stream_until(5_000)
    assert [kind for kind, _ in client.packets] == [DATA, DATA, DATA, COMMAND, DATA, DATA, DATA]
    client.server.elapsed_us = None
    assert client.ask("StreamFrames 3D") == [(NO_DATA, b""), (COMMAND, b"OK-StreamFrames 3D")]


# Bytes ----------------------------------------------------------------------------------------


async def test_a_delay_keeps_the_order_of_all_packets(client: FaultyClient) -> None:
    """Delayed bytes are one stream: what a fault adds comes after them, and the end of a fault loses none."""
    [delay] = client.begin(Delay(delay_ms=80))
    client.send("Version 1.0")
    await asyncio.sleep(0.05)
    client.begin(Undersize())
    client.send("Fly")
    client.faults.end(delay)
    client.send("Version 1.0")
    assert client.filter.waiting_bytes > 0
    await asyncio.sleep(1)
    kinds = [int.from_bytes(data[4:8], "big") for _, data in client.writes]
    assert kinds == [COMMAND, DATA, ERROR, COMMAND]
    times_s = [time_s for time_s, _ in client.writes]
    assert times_s == pytest.approx([0.08, 0.08, 0.13, 0.13], abs=0.0011)  # timers count whole ms


@pytest.mark.parametrize(
    ("faults", "gaps_s", "writes"),
    [
        pytest.param(
            (Merge(window_ms=20), Delay(delay_ms=50)), [0.0] + [0.015] * 3, [1] * 4, id="four windows"
        ),
        pytest.param((Merge(window_ms=1000),), [0.5, 0.0, 0.25], [3], id="one window"),
    ],
)
async def test_merge_joins_the_packets_of_one_window_only(
    client: FaultyClient, faults: tuple[Fault, ...], gaps_s: list[float], writes: list[int]
) -> None:
    """That is what a client with one recv per packet fails at (field note 15)."""
    client.begin(*faults)
    for gap_s in gaps_s:
        await asyncio.sleep(gap_s)
        client.send("Version 1.0")
    await asyncio.sleep(2)
    assert [len(data) // len(packet(*VERSION)) for _, data in client.writes] == writes


async def test_jitter_split_and_merge_together_keep_all_packets_in_order(client: FaultyClient) -> None:
    """The client sees one intact stream, whatever the faults do to its timing."""
    active = client.begin(
        Jitter(mean_ms=3), Split(pieces=5, pause_ms=1), Merge(window_ms=4), Delay(delay_ms=1)
    )
    client.send("StreamFrames 3D")
    for elapsed_us in range(0, 200_000, 1000):
        client.stream_until(elapsed_us)
        await asyncio.sleep(0.001)
    await asyncio.sleep(10)
    bodies = [body for kind, body in client.packets if kind == DATA]
    assert [components_in(body)[0].frame_number for body in bodies] == list(range(1, 201))
    assert [fault.num_happened for fault in active] == [201] * 4


async def test_the_waiting_bytes_are_limited(client: FaultyClient, caplog: pytest.LogCaptureFixture) -> None:
    """A delay must not fill the memory; once the bytes are sent, there is room again."""
    large = packet(DATA, bytes(MAX_WAITING_BYTES // 4 - 8))
    client.begin(Delay(delay_ms=1000))
    for expected in (4, 8):
        for _ in range(6):
            client.filter.send(large)
        assert client.filter.waiting_bytes == MAX_WAITING_BYTES
        await asyncio.sleep(2)
        assert len(client.writes) == expected
    assert caplog.text.count("dropping packets") == 1


async def test_a_slow_reader_reads_everything_late(client: FaultyClient) -> None:
    """Commands wait for the slowest of the faults, even if another fault ends meanwhile."""
    client.begin(SlowReader(bytes_per_s=19), SlowReader(bytes_per_s=9.5))
    [other] = client.begin(Delay(delay_ms=1))
    client.send("Version 1.0")  # of 19 bytes
    client.faults.end(other)
    await asyncio.sleep(0.5)
    client.send("Version 1.0")
    await asyncio.sleep(1.4)
    assert client.writes == []
    assert client.calls[0] == "pause_reading"
    await asyncio.sleep(0.2)
    assert client.packets == [VERSION, VERSION]
    assert client.calls[-1] == "resume_reading"


async def test_a_half_open_server_loses_what_it_sends_and_reads_when_it_ends(client: FaultyClient) -> None:
    """The client has no way to notice it but a time-out."""
    client.send("StreamFrames 3D")
    first, second = client.begin(HalfOpen(), HalfOpen())
    client.stream_until(5_000)
    assert client.ask("Version 1.0") == []
    assert (first.num_happened, client.filter.waiting_bytes) == (7, 19)
    client.faults.end(first)
    await asyncio.sleep(1000)
    assert client.writes == []
    client.faults.end(second)
    assert client.packets == [VERSION]


async def test_nothing_is_sent_after_the_connection_has_ended(client: FaultyClient) -> None:
    """The bytes that faults hold back belong to a connection that no longer exists."""
    client.begin(Delay(delay_ms=10), LateAcknowledgements(delay_ms=10), SlowReader(bytes_per_s=1000))
    client.send("Version 1.0", "SendParameters")
    await asyncio.sleep(0.04)
    client.send("SendParameters")
    assert client.filter.waiting_bytes > 0
    client.filter.connection_lost()
    assert client.filter.waiting_bytes == 0
    num_writes = len(client.writes)
    await asyncio.sleep(1000)
    assert len(client.writes) == num_writes


async def test_everything_is_sent_before_the_server_closes_the_connection(client: FaultyClient) -> None:
    """Bye is answered in spite of any delay, and after what came before it."""
    client.begin(Delay(delay_ms=600_000), LateAcknowledgements(delay_ms=600_000))
    client.send("Version 1.0", "Bye")
    client.filter.flush()
    assert client.packets == [VERSION, (COMMAND, b"bye")]


# Which connections, when and how often --------------------------------------------------------


async def test_faults_act_in_the_order_of_their_kinds(client: FaultyClient) -> None:
    """So a scenario means the same in whatever order its faults begin."""
    [delay] = client.begin(Delay())
    client.begin(ReplyText(), Undersize(), NoMeasurement())
    assert client.faults.active == [NoMeasurement(), ReplyText(), Delay()]
    client.faults.end(delay)
    assert client.faults.active == [NoMeasurement(), ReplyText()]


async def test_a_fault_can_affect_one_connection_only(client: FaultyClient) -> None:
    """Lasting faults and those of one moment count connections from 1."""
    second = FaultyClient(2, client.simulator)
    client.begin(Undersize(connection=2), ReplyText(form="echo", connection=2))
    assert client.packets == []
    assert [data for _, data in second.writes] == [UNDERSIZE]
    assert client.ask("Version 1.0") == [VERSION]
    assert second.ask("Version 1.0") == [(COMMAND, b"Version 1.0")]


async def test_a_frame_fault_happens_as_often_as_times_allows(client: FaultyClient) -> None:
    """Only frames that it changes count."""
    numbers, events = client.begin(ConstantFrameNumbers(frame_number=5, times=2), ShortEvents())
    client.send("Version 1.0", "StreamFrames 3D Events")
    client.stream_until(70_000)
    frames = [components_in(body, event_bytes=16) for kind, body in client.packets if kind == DATA]
    assert [frame[0].frame_number for frame in frames[:4]] == [5, 5, 3, 4]
    assert frames[-1][1].type == EVENT
    assert (numbers.num_happened, events.num_happened) == (2, 1)


async def test_planned_faults_begin_at_their_times_and_as_often_as_times_allows(
    client: FaultyClient, caplog: pytest.LogCaptureFixture
) -> None:
    """Times count from the start of the scenario, and intervals from one beginning to the next."""
    caplog.set_level(logging.INFO, "gateway.simulator")
    client.faults.play([Undersize(at_s=3, every_s=10, times=4), Garbage(at_s=600)])
    await asyncio.sleep(599)
    times_s = [time_s for time_s, _ in client.writes]
    assert len(times_s) == 4
    assert times_s[0] == 3
    intervals_s = {later - earlier for earlier, later in pairwise(times_s)}
    assert all(5 <= interval_s <= 15 for interval_s in intervals_s)
    assert len(intervals_s) == 3
    assert "garbage" not in caplog.text
    await client.faults.clear()
    await asyncio.sleep(10)
    assert len(client.writes) == 4


async def test_a_lasting_fault_ends_after_its_duration_and_begins_again(
    client: FaultyClient, caplog: pytest.LogCaptureFixture
) -> None:
    """The log shows each beginning and end in the form of the command line."""
    caplog.set_level(logging.INFO, "gateway.simulator")
    client.faults.play([MissingAcknowledgements(at_s=1, every_s=4, for_s=1)])
    replies = []
    for _ in range(30):
        await asyncio.sleep(0.5)
        replies.append(bool(client.ask("Version 1.0")))
    begun = [message.split()[1] for message in caplog.messages if message.startswith("Fault")]
    assert begun[:4] == ["begins:", "ends:", "begins:", "ends:"]
    assert 2 <= begun.count("begins:") <= 7
    assert replies[0]
    assert 2 * begun.count("ends:") <= replies.count(False) <= 2 * begun.count("begins:") + 1
    assert names(caplog.messages[0], "missing_acknowledgements,at_s=1,every_s=4,for_s=1")
    assert names(caplog.messages[1], "missing_acknowledgements,at_s=1,every_s=4,for_s=1", "2 times")


async def test_the_same_seed_gives_the_same_random_bytes(client: FaultyClient) -> None:
    """A failure that a scenario provokes can be provoked again."""
    heard: list[bytes] = []
    for seed in (1, 1, 2):
        client.faults.play([], seed=seed)
        client.begin(Garbage(num_bytes=20))
    heard.extend(data for _, data in client.writes)
    assert heard[0] == heard[1] != heard[2]
    assert {len(data) for data in heard} == {20}
