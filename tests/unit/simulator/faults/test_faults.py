"""What each kind of fault does to replies and to the byte stream, and the times at which faults begin."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.rtc3d.packets import Packet
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.held_replies import HeldReplies
from gateway.simulator.faults.momentary_faults import Cut, Oversize, Undersize
from gateway.simulator.faults.outgoing import PendingWrite, Reply
from gateway.simulator.faults.reply_faults import MinimalServer, RefusedCommands
from gateway.simulator.faults.stream_faults import Delay, Jitter, Merge, Split
from tests.unit.rtc3d_server.wire import COMMAND, DATA, packet
from tests.unit.simulator.faults.faulty_client import FaultyClient, active, played, writes_for

# Replies --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("refused", "texts"),
    [
        (False, ["StreamFrames", "STREAMFRAMES\0", "StreamFrames FrequencyDivisor:4", "StreamFrames Stop"]),
        (False, ["SendCurrentFrame"]),
        (
            True,
            ["Version 1.0", "SetByteOrder LittleEndian", "SendParameters", "SendParameters All", "Bye", ""],
        ),
        (
            True,
            ["StreamFrames AllFrames", "StreamFrames Frequency:60", "StreamFrames 3D", "SendCurrentFrame 3D"],
        ),
        (True, ["StreamFrames FrequencyDivisor:4 3D"]),
    ],
)
def test_a_minimal_server_accepts_only_the_commands_of_field_note_2(refused: bool, texts: list[str]) -> None:
    """The gateway's fallback to simpler commands is tested against this server."""
    for text in texts:
        assert (MinimalServer().refusal(Packet(COMMAND, text.encode())) is not None) == refused, text


def test_refused_commands_are_recognised_by_their_first_word() -> None:
    """Other commands, and packets that are none, are not refused."""
    fault = RefusedCommands(commands=("setbyteorder", "bye"))
    texts = {
        "SetByteOrder BigEndian": "setbyteorder is refused",
        "bye\0": "bye is refused",
        "Version 1.0": None,
        "": None,
    }
    assert {text: fault.refusal(Packet(COMMAND, text.encode())) for text in texts} == texts
    for each in (MinimalServer(), RefusedCommands(commands=("version",))):
        assert each.refusal(Packet(DATA, b"Version 1.0")) is None


def test_a_frame_that_a_released_reply_causes_releases_no_reply_twice() -> None:
    """Sending a reply may come back here before the others are released."""
    sent: list[bytes] = []

    def send(reply: bytes) -> None:
        sent.append(reply)
        held.packet_sent(packet(DATA))

    held = HeldReplies(send)
    first, second = packet(COMMAND, b"first"), packet(COMMAND, b"second")
    held.hold(Reply(first, after_frames=1))
    held.hold(Reply(second, after_frames=1))
    assert held.waiting_bytes == len(first + second)
    held.packet_sent(packet(DATA))
    assert (sent, held.waiting_bytes) == ([first, second], 0)


# Bytes ----------------------------------------------------------------------------------------


@given(st.binary(min_size=1, max_size=60), st.integers(2, 70), st.integers(0, 2**32))
def test_split_writes_all_bytes_in_their_order_in_pieces(data: bytes, pieces: int, seed: int) -> None:
    """A piece is never empty, and a short packet has fewer of them."""
    fault = Split(pieces=pieces, pause_ms=2)
    writes = writes_for(fault, data, active(fault, seed))
    assert b"".join(write.data for write in writes) == data
    assert len(writes) == min(pieces, len(data))
    assert all(write.data for write in writes)
    assert [write.due_s for write in writes] == [100.0 + 0.002 * k for k in range(len(writes))]


def test_merge_delays_writes_to_the_end_of_the_window() -> None:
    """Windows are those of the clock, so they do not drift."""
    fault = Merge(window_ms=250)
    writes = [
        fault.change_writes([PendingWrite(time_s, b"x")], active(fault))[0]
        for time_s in (100.01, 100.2, 100.25, 100.3)
    ]
    assert [write.due_s for write in writes] == [100.25, 100.25, 100.25, 100.5]
    assert all(write.joins_previous for write in writes)


def test_jitter_is_exponential_with_the_configured_mean() -> None:
    """That is how queues in a network delay packets: mostly little, seldom much."""
    fault = Jitter(mean_ms=5)
    jitter = active(fault)
    delay_ms = np.array([(writes_for(fault, b"x", jitter)[0].due_s - 100) * 1000 for _ in range(4000)])
    assert delay_ms.min() >= 0
    assert delay_ms.mean() == pytest.approx(5, rel=0.1)
    assert np.mean(delay_ms > 5) == pytest.approx(np.exp(-1), rel=0.1)


@pytest.mark.parametrize(
    ("fault", "size", "calls"),
    [
        *((Oversize(), 0xFFFFFFFF, []), (Oversize(size_bytes=20_000_000), 20_000_000, [])),
        *((Undersize(), 0, []), (Undersize(size_bytes=7), 7, []), (Cut(), 1000, ["close"])),
    ],
)
@played
async def test_a_header_can_announce_what_does_not_follow(
    client: FaultyClient, fault: Fault, size: int, calls: list[str]
) -> None:
    """A reader must not wait for it forever, or allocate memory for it."""
    client.begin(fault)
    [(_, data)] = client.writes
    assert data[:8] == struct.pack(">II", size, DATA)
    assert (len(data) > 8, client.calls) == (bool(calls), calls)


# Times ----------------------------------------------------------------------------------------


def delays_s(fault: Fault, seed: int) -> list[float]:
    planned = active(fault, seed)
    return [planned.first_delay_s(), *(planned.random_interval_s(fault.every_s or 0.0) for _ in range(200))]


def test_a_repeated_fault_begins_at_random_intervals_that_are_the_same_for_the_same_seed() -> None:
    """A failure in the lab can be provoked again, and neither frames nor the load of the machine matter."""
    fault = Delay(every_s=4, for_s=1)
    first = delays_s(fault, 1)
    assert all(2 <= delay_s <= 6 for delay_s in first)
    assert np.mean(first) == pytest.approx(4, rel=0.1)
    assert first == delays_s(fault, 1) != delays_s(fault, 2)
    jitter = Jitter(every_s=4, for_s=1)
    idle, busy = active(jitter), active(jitter)
    for _ in range(10):
        writes_for(jitter, b"x", busy)
    assert idle.first_delay_s() == busy.first_delay_s()


def test_a_fault_first_begins_at_its_time_or_at_once() -> None:
    """``every_s`` alone postpones it, so that a client can connect first."""
    for fault, delay_s in (
        (Delay(at_s=3, every_s=5, for_s=1), 3),
        (Delay(), 0),
        (Delay(at_s=0, every_s=5, for_s=1), 0),
    ):
        assert active(fault).first_delay_s() == delay_s
