"""Time stamps and frame numbers of any size, in any order: all that is computed from them can be encoded."""

import logging
from collections.abc import Iterator

import numpy as np
import pytest
import rtc3d
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import decode, to_json
from gateway.messages.summary import summarise
from gateway.messages.texts import encode_within_limits
from gateway.publish.fan_out import FanOut
from gateway.publish.status_messages import clock_message, status_message
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.session.ingest import Ingest
from gateway.session.rate_check import RateWatch
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from gateway.tools.doctor.observation import ObservedComponent
from tests.support.examples import examples
from tests.support.memory_output import MemoryOutput

EDGES = [edge + near for edge in (-(2**63), -(2**32), 0, 2**31, 2**32, 2**53, 2**62) for near in (-1, 0, 1)]
timestamps_us = st.sampled_from([edge for edge in [*EDGES, 2**63 - 1] if edge >= -(2**63)]) | st.integers(
    -(2**63), 2**63 - 1
)
frame_numbers = st.sampled_from((-(2**31), -1, 0, 1, 2**31 - 1)) | st.integers(-(2**31), 2**31 - 1)

steps = st.tuples(
    st.none() | timestamps_us,  # jump there first
    st.sampled_from((0, 1, 2500, 10**6, 2**40, 2**58)),  # then advance by this with each frame
    st.none() | frame_numbers,
    st.sampled_from((0, 1, 2)),  # the step of the frame numbers
    st.integers(1, 250),  # how many frames
    st.sampled_from((0, 1, 2500, 100_000)),  # the time between their arrivals
)

BOOT_UTIME = 1_700_000_000_000_000
WANTED = {"components": ["3d", "6d", "event"]}


def in_range(value: int, bits: int) -> int:
    """Return the value as a signed integer of so many bits, as the server's counter would wrap."""
    half = 1 << (bits - 1)
    return (value + half) % (2 * half) - half


class Lab:
    """What a source does with frames, up to an output."""

    def __init__(self, backlog: str) -> None:
        self.output = MemoryOutput()
        self.output.max_rate_hz = {ComponentType.MARKERS: 30.0}
        self.fan_out = FanOut("lab", [self.output])
        self.status = StreamStatus("3d 6d event", name="lab")
        self.stream = StreamSettings.model_validate({**WANTED, "backlog": backlog})
        self.ingest = Ingest(
            SourceSettings(name="lab", host="192.0.2.20"),
            self.stream,
            self.status,
            self.fan_out.publish,
            self.fan_out.skip,
            lambda _halvings: None,
            lambda: None,
        )
        self.watch = RateWatch(self.status)
        self.status.state = StreamState.STREAMING
        self.steady_us = 10**9
        self.observed = ObservedComponent(self.steady_us)

    def receive(self, number: int, timestamp_us: int) -> None:
        parts = [
            encode_component(kind, number, timestamp_us, ITEM_ZEROS[kind])
            for kind in (ComponentType.MARKERS, ComponentType.TOOLS)
        ]
        frame = split_frame(encode_frame(parts), "big")
        self.ingest.receive([frame], BOOT_UTIME + self.steady_us, self.steady_us)
        self.observed.add(frame.components[0], self.steady_us)

    def check(self) -> None:
        status = status_message(
            source="lab",
            server="s",
            sequence=1,
            streams=[(self.status, 1e39)],
            outputs=[],
            stall_timeout_s=2.0,
            frame=CoordinateFrame("lab"),
        )
        for message in (encode_within_limits(status), encode_within_limits(clock_message(1, 1, self.status))):
            decoded = decode(message)
            summarise(decoded)
            to_json(decoded)
        self.watch.check(
            self.stream,
            {ComponentType.MARKERS: 200.0},
            self.ingest.arrivals,
            self.steady_us / 1e6,
            is_full_rate=True,
            reports_sharing=True,
        )
        assert self.observed.rate_hz >= 0
        for _, message in self.output.messages:
            decoded = decode(message)
            summarise(decoded)
            assert BOOT_UTIME + 10**9 <= decoded.capture_utime <= decoded.utime
        self.output.messages.clear()


ITEM_ZEROS = {kind: np.zeros(1, ITEM_DTYPES[kind]) for kind in ComponentType}


@pytest.fixture(scope="module", autouse=True)
def _no_log() -> Iterator[None]:
    """Millions of log records would take longer than the test."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@example([(None, 2**58, None, 0, 33, 0)], "all")  # time stamps that wrap around
@settings(max_examples=examples(60))
@given(st.lists(steps, min_size=1, max_size=8), st.sampled_from(("all", "latest")))
def test_any_time_stamps_can_be_published(
    phases: list[tuple[int | None, int, int | None, int, int, int]], backlog: str
) -> None:
    lab = Lab(backlog)
    timestamp_us = number = 0
    for jump_us, step_us, jump_number, step, count, arrival_step_us in phases:
        timestamp_us = timestamp_us if jump_us is None else jump_us
        number = number if jump_number is None else jump_number
        for _ in range(count):
            lab.receive(number, timestamp_us)
            timestamp_us, number = in_range(timestamp_us + step_us, 64), in_range(number + step, 32)
            lab.steady_us += arrival_step_us
        lab.check()


numbers = st.integers() | st.sampled_from((2**63, -(2**63) - 1, 10**400))
floats = st.floats() | st.sampled_from((1e39, -1e300, float("nan"))) | st.just(10**400)


@given(numbers, floats, st.text(st.characters()))
def test_any_values_of_a_status_can_be_encoded(number: int, value: float, text: str) -> None:
    stream, output = rtc3d.stream_status_t(), rtc3d.output_status_t()
    loss, count = rtc3d.loss_t(), rtc3d.count_t()
    stream.session = stream.frames_in = stream.clock.offset_us = loss.messages = count.count = number
    stream.frame_rate_hz = stream.lag_ms = stream.clock.drift_ppm = value
    stream.state = stream.last_error = loss.cause = count.name = output.problem = text
    stream.limitations, stream.num_limitations = [text], 1
    stream.drops, stream.num_drops = [loss], 1
    output.messages, output.num_messages = [count], 1
    status = rtc3d.status_t()
    status.utime = status.session = number
    status.source = text
    status.streams, status.num_streams = [stream], 1
    status.outputs, status.num_outputs = [output], 1
    decoded = decode(encode_within_limits(status))
    assert decoded.utime == max(-(2**63), min(number, 2**63 - 1))
    assert decoded.session == max(-(2**31), min(number, 2**31 - 1))
    assert decoded.streams[0].last_error.isprintable()
