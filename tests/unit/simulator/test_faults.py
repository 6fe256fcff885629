"""How each kind of fault changes packets, by the specification's tables, and when it begins."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError, FrameError
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet
from gateway.simulator.faults.base import ActiveFault, Fault, LastingConnectionFault
from gateway.simulator.faults.frame_faults import (
    ConstantFrameNumbers,
    FrozenTimestamps,
    JumpingTimestamps,
    Occlusion,
    ShortEvents,
    UnknownComponent,
    WrongByteOrder,
    WrongCounts,
)
from gateway.simulator.faults.kinds import KINDS, describe_kinds, parse_fault, summary_of
from gateway.simulator.faults.outgoing import PendingWrite
from gateway.simulator.faults.reply_faults import MinimalServer, RefusedCommands
from gateway.simulator.faults.server_faults import Restart
from gateway.simulator.faults.stream_faults import Delay, HalfOpen, Jitter, Merge, SlowReader, Split
from gateway.simulator.scene_settings import SceneSettings
from gateway.simulator.simulator import Simulator
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, DATA, MARKERS, TOOLS, ByteOrder, Part, cut, frame_of, packet

MISSING = b"\xff" * 4


def active(fault: Fault, seed: int = 1) -> ActiveFault:
    return ActiveFault(fault, Simulator(CountingScene()).faults, np.random.default_rng(seed))


def markers(
    byte_order: ByteOrder = "big", count: int = 2, number: int = 7, timestamp_us: int = 9000
) -> bytes:
    """A 3D component; marker k is at (k, 1.5, -2) with the residual 0.25."""
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


def parts_of(data: bytes, byte_order: ByteOrder = "big", event_bytes: int = 24) -> list[Part]:
    [(packet_type, body)] = cut(data)
    assert packet_type == DATA
    return frame_of(body, byte_order, event_bytes=event_bytes)


# Frames -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "hidden"), [(0.0, 0), (0.01, 1), (0.5, 4), (0.51, 5), (1.0, 8)])
def test_occlusion_hides_a_share_of_the_markers(share: float, hidden: int) -> None:
    [part] = parts_of(changed(Occlusion(markers=share), frame(markers(count=8))))

    seen = [item for item in part.items if not math.isnan(item[0])]
    assert len(seen) == 8 - hidden
    assert all(item == (item[0], 1.5, -2.0, 0.25) for item in seen)


def test_a_hidden_marker_and_a_hidden_tool_have_the_bits_of_the_field_notes() -> None:
    tool = struct.pack(">IIiqI8f", 24 + 32, TOOLS, 7, 9000, 1, 1, 0, 0, 0, 10, 20, 30, 0.5)

    data = changed(Occlusion(), frame(markers(count=1), tool))

    assert data[8 + 4 + 24 : 8 + 4 + 40] == MISSING * 3 + struct.pack(">f", 999.0)
    assert data[-32:] == MISSING * 8
    assert [(part.type, part.frame_number, part.timestamp_us) for part in parts_of(data)] == [
        (MARKERS, 7, 9000),
        (TOOLS, 7, 9000),
    ]


def test_occlusion_hides_the_same_markers_until_it_begins_again() -> None:
    fault = Occlusion(markers=0.5)
    occlusion = active(fault)
    occlusion.begin()
    first, second = (changed(fault, frame(markers(count=100)), occlusion) for _ in range(2))
    occlusion.begin()
    third = changed(fault, frame(markers(count=100)), occlusion)

    assert first == second
    assert first != third


def test_frozen_time_stamps_are_the_time_when_the_fault_began() -> None:
    frozen = active(FrozenTimestamps())
    frozen.began_us = 1234
    data = changed(FrozenTimestamps(), frame(markers(number=1), markers(number=2)), frozen)
    assert data == frame(markers(number=1, timestamp_us=1234), markers(number=2, timestamp_us=1234))


@pytest.mark.parametrize(("jump_ms", "timestamp_us"), [(-5, 4000), (0.5, 9500), (1e12, 10**15 + 9000)])
def test_time_stamps_jump(jump_ms: float, timestamp_us: int) -> None:
    data = changed(JumpingTimestamps(jump_ms=jump_ms), frame(markers()))
    assert data == frame(markers(timestamp_us=timestamp_us))


def test_frame_numbers_can_be_constant() -> None:
    assert changed(ConstantFrameNumbers(frame_number=-3), frame(markers())) == frame(markers(number=-3))


def test_events_can_have_16_bytes() -> None:
    header = struct.Struct(">IIiqI")
    long = header.pack(24 + 48, 5, 7, 9000, 2) + struct.pack(
        ">iqiiiiqiii", 1, 8000, 2, 3, 4, 5, 8500, 6, 7, 8
    )
    short = header.pack(24 + 32, 5, 7, 9000, 2) + struct.pack(">8i", 1, 2, 3, 4, 5, 6, 7, 8)
    assert changed(ShortEvents(), frame(markers(), long)) == frame(markers(), short)


@pytest.mark.parametrize(
    ("order", "requested", "sent"),
    [
        ("big", "little", "big"),
        ("little", "little", "little"),
        ("little", "big", "little"),
        ("other", "big", "little"),
        ("other", "little", "big"),
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
    [(_, body)] = cut(changed(WrongCounts.model_validate({"field": field}), good))

    assert len(body) == len(good) - 8
    for order in ("big", "little"):
        with pytest.raises(FrameError):
            split_frame(body, order)


FRAME_KINDS = [kind for kind in KINDS.values() if kind.__module__.endswith("frame_faults")]


@pytest.mark.parametrize("kind", FRAME_KINDS)
@pytest.mark.parametrize(
    "data",
    [packet(COMMAND, b"OK-Version 1.0"), packet(4), packet(DATA, b"no frame"), packet(2, b"<x/>"), b"half"],
)
def test_faults_of_frames_do_not_change_other_packets(
    kind: type[LastingConnectionFault], data: bytes
) -> None:
    assert changed(kind(), data) == data


# The stream ---------------------------------------------------------------------------------


@given(st.binary(min_size=1, max_size=60), st.integers(2, 70), st.integers(0, 2**32))
def test_split_writes_all_bytes_in_their_order_in_pieces(data: bytes, pieces: int, seed: int) -> None:
    fault = Split(pieces=pieces, pause_ms=2)

    writes = writes_for(fault, data, active(fault, seed))

    assert b"".join(write.data for write in writes) == data
    assert len(writes) == min(pieces, len(data))
    assert all(write.data for write in writes)
    assert [write.due_s for write in writes] == [100.0 + 0.002 * k for k in range(len(writes))]


def test_merge_delays_writes_to_the_end_of_the_window() -> None:
    fault = Merge(window_ms=250)
    due_s = [100.01, 100.2, 100.25, 100.3]
    writes = [fault.change_writes([PendingWrite(time_s, b"x")], active(fault))[0] for time_s in due_s]
    assert [(write.due_s, write.joins_previous) for write in writes] == [
        (100.25, True),
        (100.25, True),
        (100.25, True),
        (100.5, True),
    ]


def test_delay_is_the_same_for_each_packet() -> None:
    assert writes_for(Delay(delay_ms=80), b"x") == [PendingWrite(100.08, b"x")]


def test_jitter_is_exponential_with_the_configured_mean() -> None:
    fault = Jitter(mean_ms=5)
    jitter = active(fault)
    delay_ms = np.array([(writes_for(fault, b"x", jitter)[0].due_s - 100) * 1000 for _ in range(4000)])

    assert delay_ms.min() >= 0
    assert delay_ms.mean() == pytest.approx(5, rel=0.1)
    assert np.mean(delay_ms > 5) == pytest.approx(np.exp(-1), rel=0.1)


def test_a_half_open_server_neither_writes_nor_reads() -> None:
    assert writes_for(HalfOpen(), b"x") == []
    assert HalfOpen().read_delay_s(1) == math.inf


def test_a_slow_reader_needs_the_same_time_for_each_byte() -> None:
    assert SlowReader(bytes_per_s=50).read_delay_s(20) == 0.4


# Replies ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        ("Version 1.0", True),
        ("SetByteOrder LittleEndian", True),
        ("SendParameters", True),
        ("SendParameters All", True),
        ("StreamFrames", False),
        ("STREAMFRAMES\0", False),
        ("StreamFrames FrequencyDivisor:4", False),
        ("StreamFrames Stop", False),
        ("StreamFrames AllFrames", True),
        ("StreamFrames Frequency:60", True),
        ("StreamFrames FrequencyDivisor:4 3D", True),
        ("StreamFrames 3D", True),
        ("SendCurrentFrame", False),
        ("SendCurrentFrame 3D", True),
        ("Bye", True),
        ("", True),
    ],
)
def test_a_minimal_server_accepts_only_the_commands_of_field_note_2(text: str, is_refused: bool) -> None:
    assert (MinimalServer().refusal(Packet(COMMAND, text.encode())) is not None) == is_refused


def test_refused_commands_are_recognised_by_their_first_word() -> None:
    fault = RefusedCommands(commands=("setbyteorder", "bye"))
    refused = {
        text: fault.refusal(Packet(COMMAND, text.encode()))
        for text in ("SetByteOrder BigEndian", "bye\0", "Version 1.0", "StreamFrames", "")
    }
    assert refused == {
        "SetByteOrder BigEndian": "setbyteorder is refused",
        "bye\0": "bye is refused",
        "Version 1.0": None,
        "StreamFrames": None,
        "": None,
    }


def test_packets_that_are_no_commands_are_not_refused() -> None:
    for fault in (MinimalServer(), RefusedCommands(commands=("version",))):
        assert fault.refusal(Packet(DATA, b"Version 1.0")) is None


# When ---------------------------------------------------------------------------------------


def delays_s(fault: Fault, seed: int) -> list[float]:
    planned = active(fault, seed)
    return [planned.first_delay_s(), *(planned.random_interval_s(fault.every_s or 0.0) for _ in range(200))]


def test_a_repeated_fault_begins_at_random_intervals_that_are_the_same_for_the_same_seed() -> None:
    fault = Delay(every_s=4, for_s=1)
    first = delays_s(fault, 1)

    assert all(2 <= delay_s <= 6 for delay_s in first)
    assert np.mean(first) == pytest.approx(4, rel=0.1)
    assert first == delays_s(fault, 1)
    assert first != delays_s(fault, 2)


def test_the_times_of_a_fault_do_not_depend_on_how_many_packets_it_changed() -> None:
    fault = Jitter(every_s=4, for_s=1)
    idle, busy = active(fault), active(fault)
    for _ in range(10):
        writes_for(fault, b"x", busy)
    assert idle.first_delay_s() == busy.first_delay_s()


def test_a_fault_first_begins_at_its_time_or_at_once() -> None:
    assert active(Delay(at_s=3, every_s=5, for_s=1)).first_delay_s() == 3
    assert active(Delay()).first_delay_s() == 0


# Names and the command line's form ----------------------------------------------------------


def test_no_kind_of_fault_needs_a_parameter() -> None:
    assert set(KINDS) == {
        *("delay", "jitter", "split", "merge", "cut", "half_open", "slow_reader", "garbage"),
        *("oversize", "undersize", "wrong_counts", "wrong_byte_order", "unknown_component"),
        *("refused_commands", "minimal_server", "reply_text", "frames_first"),
        *("doubled_acknowledgements", "missing_acknowledgements", "late_acknowledgements"),
        *("no_measurement", "restart", "change_scene", "occlusion"),
        *("frozen_timestamps", "jumping_timestamps", "constant_frame_numbers", "short_events"),
    }
    for name, kind in KINDS.items():
        assert parse_fault(name) == kind()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("delay,delay_ms=80,at_s=5,for_s=3", Delay(delay_ms=80, at_s=5, for_s=3)),
        ("jitter,mean_ms=5", Jitter(mean_ms=5)),
        (
            "restart,away_s=2,scene.markers=12,scene.marker_label=M",
            Restart(away_s=2, scene=SceneSettings(markers=12, marker_label="M")),
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
    ("text", "expected"),
    [
        (
            "dely,at_s=1",
            r"fault 'dely,at_s=1': fault: found 'dely' \(did you mean 'delay'\?\); expected no_me",
        ),
        ("", r"fault '': fault: found ''; expected no_measurement,"),
        (
            "cut,at=1",
            r"at: unknown key \(did you mean 'at_s'\?\); known keys: at_s, every_s, times, connection, reset",
        ),
        ("cut,reset=1", "reset: found 1; expected true or false"),
        ("cut,reset", "found 'reset'; expected NAME=VALUE, each name once"),
        ("cut,at_s=1,at_s=2", "found 'at_s=2'; expected NAME=VALUE, each name once"),
        ("cut,fault=delay", "found 'fault=delay'; expected NAME=VALUE, each name once"),
        (
            "delay,delay_ms=-1",
            "delay_ms: found -1; expected a number of milliseconds above 0, up to 600000",
        ),
        ("delay,delay_ms=[", r"delay_ms: found '\['; expected a number"),
        ("delay,delay_ms=.nan", "delay_ms: found nan; expected a number"),
        ("delay,every_s=2", "every_s: found every_s without for_s; expected both"),
        ("restart,scene=3", "scene: found 3; expected a mapping with any of the keys markers, tools"),
        ("restart,scene=3,scene.markers=1", "scene has both a value and parts; expected only one of them"),
        ("restart,scene.markers=1.5", "scene.markers: found 1.5; expected a whole number from 0 to 10000"),
        (
            "refused_commands,commands=[]",
            "commands: found an empty list; expected the first word of a command",
        ),
        ("refused_commands,commands=[fly]", "commands.0: found 'fly'; expected version, setbyteorder"),
    ],
)
def test_an_invalid_fault_is_reported_in_a_sentence(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse_fault(text)


def test_the_description_of_the_kinds_has_each_with_its_parameters() -> None:
    text = describe_kinds()
    for name, kind in KINDS.items():
        assert f"\n{name}" in f"\n{text}"
        assert f"    {summary_of(kind)}" in text
        for parameter in kind.model_fields:
            assert parameter in text
    assert "delay_ms=100  The delay in milliseconds." in text
