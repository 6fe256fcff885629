"""Faults of the byte stream."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.simulator.faults.outgoing import PendingWrite
from gateway.simulator.faults.stream_faults import Delay, HalfOpen, Jitter, Merge, SlowReader, Split
from tests.unit.simulator.faults.faulty_packets import active, writes_for


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
