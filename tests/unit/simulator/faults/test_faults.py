"""The kinds of faults: their names, and what each does to replies, to the byte stream and to frames."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError, FrameError
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet
from gateway.simulator.fault_pipeline import HeldReplies
from gateway.simulator.faults import (
    ActiveFault,
    Cut,
    Delay,
    Fault,
    Jitter,
    LastingConnectionFault,
    Merge,
    Oversize,
    PendingWrite,
    Reply,
    Restart,
    Split,
    Undersize,
)
from gateway.simulator.packet_faults import (
    FrameFault,
    FrozenTimestamps,
    JumpingTimestamps,
    MinimalServer,
    Occlusion,
    RefusedCommands,
    ShortEvents,
    UnknownComponent,
    WrongByteOrder,
    WrongCounts,
)
from gateway.simulator.simulator import KINDS, describe_kinds, parse_fault
from gateway.simulator.synthetic import SceneSettings
from tests.support.errors import raises
from tests.unit.session.server.wire import (
    COMMAND,
    DATA,
    MARKERS,
    TOOLS,
    ByteOrder,
    WireComponent,
    components_in,
    packet,
    packets_in,
)
from tests.unit.simulator.faults.faulty_client import FaultyClient


def active(fault: Fault, seed: int = 1) -> ActiveFault:
    return ActiveFault(fault, np.random.default_rng(seed))


def markers(
    byte_order: ByteOrder = "big", count: int = 2, number: int = 7, timestamp_us: int = 9000
) -> bytes:
    """Return a 3D component; marker k is at (k, 1.5, -2) with the residual 0.25."""
    sign = ">" if byte_order == "big" else "<"
    items = b"".join(struct.pack(sign + "4f", k, 1.5, -2.0, 0.25) for k in range(count))
    return struct.pack(sign + "IIiqI", 24 + len(items), MARKERS, number, timestamp_us, count) + items


def frame(*components: bytes, byte_order: ByteOrder = "big") -> bytes:
    sign = ">" if byte_order == "big" else "<"
    return packet(DATA, struct.pack(sign + "I", len(components)) + b"".join(components))


def writes_for(
    fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None
) -> list[PendingWrite]:
    """Return what is written instead of one packet that is due at 100 s."""
    return fault.change_writes([PendingWrite(100.0, packet)], active_fault or active(fault))


def changed(fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None) -> bytes:
    [write] = writes_for(fault, packet, active_fault)
    assert (write.due_s, write.joins_previous) == (100.0, False)
    return write.data


def components_in_packet(data: bytes) -> list[WireComponent]:
    [(packet_type, body)] = packets_in(data)
    assert packet_type == DATA
    return components_in(body)


def test_every_kind_of_fault_has_defaults_for_all_parameters() -> None:
    for name, kind in KINDS.items():
        assert parse_fault(name) == kind()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("delay,delay_ms=80,at_s=5,for_s=3", Delay(delay_ms=80, at_s=5, for_s=3)),
        ("jitter,mean_ms=5", Jitter(mean_ms=5)),
        (
            "restart,scene.markers=12,scene.marker_label=M",
            Restart(scene=SceneSettings(markers=12, marker_label="M")),
        ),
        ("refused_commands,commands=[version,bye]", RefusedCommands(commands=("version", "bye"))),
        ("refused_commands,commands=bye,times=2", RefusedCommands(commands=("bye",), times=2)),
        (
            "wrong_byte_order,byte_order=little,connection=2",
            WrongByteOrder(byte_order="little", connection=2),
        ),
    ],
)
def test_a_fault_is_parsed_from_the_form_in_which_it_is_printed(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault
    assert parse_fault(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("dely,at_s=1", ["'dely,at_s=1': fault:", "'dely'", "'delay'"]),
        ("", ["'': fault:", "''"]),
        ("cut,at=1", ["at: unknown key", "'at_s'", "at_s, every_s, times"]),
        ("cut,reset=1", ["reset:", 1, "true", "false"]),
        *(
            (f"cut,{each}", [f"'{each.split(',')[-1]}'", "NAME=VALUE"])
            for each in ("reset", "at_s=1,at_s=2", "fault=delay")
        ),
        ("delay,delay_ms=-1", ["delay_ms:", -1, 600_000]),
        ("delay,delay_ms=[", ["delay_ms:", "'['"]),
        ("delay,delay_ms=.nan", ["delay_ms:", "nan"]),
        ("delay,every_s=2", ["every_s:", "for_s"]),
        ("restart,scene=3", ["scene:", 3, "markers", "tools"]),
        ("restart,scene=3,scene.markers=1", ["scene", "value", "keys"]),
        ("restart,scene.markers=1.5", ["scene.markers:", 1.5, 10_000]),
        ("refused_commands,commands=[]", ["commands", "list"]),
        ("refused_commands,commands=[fly]", ["commands.0:", "'fly'", "version", "setbyteorder"]),
    ],
)
def test_an_invalid_fault_is_reported_with_its_parameter(text: str, values: list[object]) -> None:
    with raises(ConfigError, *values):
        parse_fault(text)


def test_the_description_of_the_kinds_has_each_with_its_parameters() -> None:
    text = describe_kinds()
    for name, kind in KINDS.items():
        assert f"\n{name}" in f"\n{text}"
        assert f"    {(kind.__doc__ or '').splitlines()[0]}" in text
        for parameter in kind.model_fields:
            assert parameter in text
    assert "delay_ms=100  The delay in milliseconds." in text


# Replies --------------------------------------------------------------------------------------


def test_a_minimal_server_accepts_only_the_commands_of_field_note_2() -> None:
    """The gateway's fallback to simpler commands is tested against this server."""
    streams = ("", "\0", " FrequencyDivisor:4", " Stop")
    accepted = ["SendCurrentFrame", "STREAMFRAMES", *(f"StreamFrames{each}" for each in streams)]
    refused_streams = (" AllFrames", " Frequency:60", " 3D", " FrequencyDivisor:4 3D")
    refused = ["Version 1.0", "SetByteOrder LittleEndian", "SendParameters", "SendParameters All", "Bye", ""]
    refused += ["SendCurrentFrame 3D", *(f"StreamFrames{each}" for each in refused_streams)]
    found = [MinimalServer().refusal(Packet(COMMAND, text.encode())) for text in accepted + refused]
    assert found[: len(accepted)] == [None] * len(accepted)
    assert None not in found[len(accepted) :]


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


# Frames ----------------------------------------------------------------------------------------


MISSING = b"\xff" * 4


@pytest.mark.parametrize(("fraction", "hidden"), [(0.0, 0), (0.01, 1), (0.5, 4), (0.51, 5), (1.0, 8)])
def test_occlusion_hides_a_fraction_of_the_markers_while_it_lasts(fraction: float, hidden: int) -> None:
    [component] = components_in_packet(changed(Occlusion(markers=fraction), frame(markers(count=8))))
    seen = [item for item in component.items if not math.isnan(item[0])]
    assert len(seen) == 8 - hidden
    assert all(item[1:] == (1.5, -2.0, 0.25) for item in seen)
    fault, data = Occlusion(markers=0.5), frame(markers(count=100))
    occlusion = active(fault)
    occlusion.begin()
    first, second = (changed(fault, data, occlusion) for _ in range(2))
    occlusion.begin()
    assert first == second != changed(fault, data, occlusion)


def test_hidden_markers_and_tools_have_the_bytes_of_field_note_7() -> None:
    tool = struct.pack(">IIiqI8f", 24 + 32, TOOLS, 7, 9000, 1, 1, 0, 0, 0, 10, 20, 30, 0.5)
    data = changed(Occlusion(), frame(markers(count=1), tool))
    assert data[8 + 4 + 24 : 8 + 4 + 40] == MISSING * 3 + struct.pack(">f", 999.0)
    assert data[-32:] == MISSING * 8
    heads = [each[:3] for each in components_in_packet(data)]
    assert heads == [(MARKERS, 7, 9000), (TOOLS, 7, 9000)]


def test_frozen_time_stamps_are_those_of_the_first_frame_since_the_fault_began() -> None:
    frozen = active(FrozenTimestamps())
    changed(FrozenTimestamps(), frame(markers(number=1, timestamp_us=1234)), frozen)
    data = changed(FrozenTimestamps(), frame(markers(number=2, timestamp_us=5)), frozen)
    assert data == frame(markers(number=2, timestamp_us=1234))
    frozen.begin()
    assert changed(FrozenTimestamps(), data := frame(markers(timestamp_us=77)), frozen) == data


@pytest.mark.parametrize(("jump_ms", "timestamp_us"), [(-5, 4000), (0.5, 9500), (1e12, 10**15 + 9000)])
def test_time_stamps_jump(jump_ms: float, timestamp_us: int) -> None:
    data = changed(JumpingTimestamps(jump_ms=jump_ms), frame(markers()))
    assert data == frame(markers(timestamp_us=timestamp_us))


def test_events_can_have_16_bytes() -> None:
    header = struct.Struct(">IIiqI")
    items = struct.pack(">iqiiiiqiii", 1, 8000, 2, 3, 4, 5, 8500, 6, 7, 8)
    long = header.pack(24 + 48, 5, 7, 9000, 2) + items
    short = header.pack(24 + 32, 5, 7, 9000, 2) + struct.pack(">8i", 1, 2, 3, 4, 5, 6, 7, 8)
    assert changed(ShortEvents(), frame(markers(), long)) == frame(markers(), short)


@pytest.mark.parametrize(
    ("order", "requested", "sent"),
    [
        *(("big", "little", "big"), ("little", "little", "little"), ("little", "big", "little")),
        *(("other", "big", "little"), ("other", "little", "big")),
    ],
)
def test_frames_can_have_another_byte_order(order: str, requested: ByteOrder, sent: ByteOrder) -> None:
    fault = WrongByteOrder.model_validate({"byte_order": order})
    data = changed(fault, frame(markers(requested), byte_order=requested))
    assert data == frame(markers(sent), byte_order=sent)


@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_an_unknown_component_comes_last_with_a_header_like_any_other(byte_order: ByteOrder) -> None:
    sign = ">" if byte_order == "big" else "<"
    unknown = struct.pack(sign + "IIiq", 20 + 5, 99, 0, 0) + bytes(5)
    data = changed(
        UnknownComponent(component_type=99, data_bytes=5), frame(markers(byte_order), byte_order=byte_order)
    )
    assert data == frame(markers(byte_order), unknown, byte_order=byte_order)


@pytest.mark.parametrize("field", ["components", "size", "items"])
@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_wrong_counts_are_invalid_in_either_byte_order(field: str, byte_order: ByteOrder) -> None:
    good = frame(markers(byte_order), markers(byte_order), byte_order=byte_order)
    [(_, body)] = packets_in(changed(WrongCounts.model_validate({"field": field}), good))
    assert len(body) == len(good) - 8
    for order in ("big", "little"):
        with pytest.raises(FrameError):
            split_frame(body, order)


FRAME_KINDS = [kind for kind in KINDS.values() if issubclass(kind, FrameFault)]


@pytest.mark.parametrize("kind", FRAME_KINDS)
@pytest.mark.parametrize(
    "data",
    [packet(COMMAND, b"OK-Version 1.0"), packet(4), packet(DATA, b"no frame"), packet(2, b"<x/>"), b"half"],
)
def test_faults_of_frames_change_no_other_packets(kind: type[LastingConnectionFault], data: bytes) -> None:
    assert changed(kind(), data) == data
