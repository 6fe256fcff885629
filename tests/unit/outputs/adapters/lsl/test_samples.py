"""LSL samples: their values, their capture times, and the messages to the process that have them."""

import json
import math
import time
from typing import Any

import numpy as np
import pytest

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.messages.host_time import HostClock, now_steady_us
from gateway.outputs.adapters.lsl.output import CaptureTimes, SuspendedTime
from gateway.outputs.adapters.lsl.process import (
    Kind,
    LslReport,
    Message,
    MessageReader,
    decode_samples,
    opening_content,
    samples_content,
)
from gateway.outputs.adapters.lsl.source_streams import samples
from gateway.rtc3d.components import ITEM_DTYPES, MISSING, WIRE_ORDER, ComponentType

MARKERS, TOOLS, ANALOG, FORCE, _ = WIRE_ORDER
NAN = math.nan
OUT_OF_VIEW = float(MISSING)
PLAIN = CoordinateFrame("lab")
HALF_TURN = CoordinateFrame("world", 1e-3, (0.0, 0.0, 1.0, 0.0), (10.0, 0.0, 0.0))
"""Half a turn about z: x and y change their signs. Then 10 m along x."""
LARGE = CoordinateFrame("lab", 10.0)


@pytest.mark.parametrize(
    ("component", "items", "frame", "num_items", "expected"),
    [
        pytest.param(MARKERS, [(1000, -2000, 500, 0.25)], PLAIN, 1, [1.0, -2.0, 0.5, 0.25], id="metres"),
        pytest.param(MARKERS, [(1000, 2000, 500, 0.25)], HALF_TURN, 1, [9.0, -2.0, 0.5, 0.25], id="turned"),
        pytest.param(
            MARKERS,
            [(OUT_OF_VIEW, OUT_OF_VIEW, OUT_OF_VIEW, 999.0), (0, 0, 0, 0.5)],
            *(HALF_TURN, 2, [NAN] * 4 + [10.0, 0.0, 0.0, 0.5]),
            id="a missing marker, also its reliability",
        ),
        pytest.param(MARKERS, [(1, NAN, 3, 0.5)], PLAIN, 1, [NAN] * 4, id="a marker without one coordinate"),
        *(
            pytest.param(MARKERS, [(x, 0, 0, 0.5)], LARGE, 1, [NAN] * 4, id="a marker beyond floats")
            for x in (math.inf, -math.inf, 3.4e38)
        ),
        pytest.param(
            TOOLS,
            [(0.5, 0.1, 0.2, 0.3, 1000, 2000, 3000, 2)],
            *(PLAIN, 1, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.5, 0.002]),
            id="the quaternion as x, y, z, w",
        ),
        pytest.param(
            TOOLS,
            [(1, 0, 0, 0, 1000, 2000, 3000, 2)],
            *(HALF_TURN, 1, [9.0, -2.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.002]),
            id="a turned tool",
        ),
        pytest.param(TOOLS, [(OUT_OF_VIEW,) * 8], HALF_TURN, 1, [NAN] * 8, id="a tool out of view"),
        pytest.param(
            FORCE,
            [(10, 20, 30, 40, 50, 60)],
            *(HALF_TURN, 1, [-10, -20, 30, -40, -50, 60]),
            id="forces are turned but not moved or scaled",
        ),
        pytest.param(ANALOG, [1.5, -2e9, NAN], HALF_TURN, 3, [1.5, -2e9, NAN], id="analog values stay"),
        pytest.param(ANALOG, [1, 2], PLAIN, 4, [1, 2, NAN, NAN], id="items that a frame lacks"),
    ],
)
def test_values_of_a_sample(
    component: ComponentType, items: list[Any], frame: CoordinateFrame, num_items: int, expected: list[float]
) -> None:
    array = np.array([items], np.float32).reshape(1, len(items), -1)
    [row] = samples(component, array, frame, num_items).tolist()
    assert row == pytest.approx(expected, rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("frame", [PLAIN, HALF_TURN])
def test_tools_are_as_the_poses_of_the_frame(frame: CoordinateFrame) -> None:
    """The same values as on all other outputs."""
    random = np.random.default_rng(1)
    items = random.normal(0, 500, (20, 8)).astype(np.float32)
    items[3, 5] = NAN
    items[4, :4] = 0
    found = samples(TOOLS, items.reshape(1, 20, 8), frame, 20).reshape(20, 8)
    tools = items.copy().view(ITEM_DTYPES[TOOLS].newbyteorder("=")).reshape(20)
    for row, pose in zip(found.tolist(), frame.poses(tools), strict=True):
        assert row == pytest.approx([NAN] * 8 if pose is None else list(pose), rel=1e-6, nan_ok=True)


def test_several_frames_are_several_samples() -> None:
    found = samples(ANALOG, np.arange(6, dtype=np.float32).reshape(3, 2, 1), PLAIN, 2)
    assert found.dtype == np.float32
    assert found.tolist() == [[0, 1], [2, 3], [4, 5]]


# Capture times, while somebody sets the wall clock ------------------------------------------------

DELAY_US = 3_000


def arriving(clock: HostClock, age_us: int = 0) -> tuple[Stamp, int]:
    """Return the stamp of a frame that arrived ``age_us`` ago, and its capture time on the steady clock."""
    arrived_us = now_steady_us() - age_us
    utime = arrived_us + clock.offset_us
    return Stamp(utime, utime - DELAY_US, 1, 1), arrived_us - DELAY_US


@pytest.mark.parametrize("step_s", [0, 3600, -3600, 0.5, -0.5])
def test_a_step_of_the_wall_clock_does_not_move_capture_times(step_s: float) -> None:
    clock = HostClock()
    times = CaptureTimes(clock)
    waiting = arriving(clock, age_us=2_000)  # arrived before the step, and is published after it
    clock.offset_us += int(step_s * 1e6)
    revealing = arriving(clock)  # its arrival has revealed the step
    for stamp, captured_us in (revealing, waiting, arriving(clock)):
        assert times.steady_us(stamp) == captured_us


def test_only_a_suspension_moves_the_steady_clock_against_the_monotonic_one() -> None:
    suspended = SuspendedTime()
    difference_us = suspended.read_us()
    assert abs(now_steady_us() - time.monotonic_ns() // 1000 - difference_us) < 1_000_000
    suspended._measured_s -= 10  # as if a second had passed
    assert suspended.read_us() == difference_us
    suspended._us -= 5_000_000  # as if the computer had slept for 5 s since then
    suspended._measured_s -= 10
    assert abs(suspended.read_us() - difference_us) < 1_000


# The messages between the gateway and its process -------------------------------------------------


def test_messages_are_cut_from_any_pieces() -> None:
    messages = [Message(Kind.OPEN, 1, b"{}"), Message(Kind.CLOSE, 258), Message(Kind.TEXTS, 300, b"x" * 5000)]
    data = b"".join(message.encode() for message in messages)
    assert messages[1].encode() == bytes([2, 2, 1, 0, 0, 0, 0, 0, 0])
    for size in (1, 7, 1000, len(data)):
        reader = MessageReader()
        pieces = (data[start : start + size] for start in range(0, len(data), size))
        assert [message for piece in pieces for message in reader.feed(piece)] == messages


def test_samples_keep_times_and_values_and_reports_are_lines() -> None:
    values = np.array([[1, 2, 3], [4, np.nan, 6]], np.float32)
    times, found = decode_samples(samples_content([100.000001, 100.000002], values))
    assert times.tolist() == [100.000001, 100.000002]
    assert np.array_equal(found, values, equal_nan=True)
    report = LslReport("118", (1, 2), "lab_3d: a\nproblem", "why")
    line = report.encode()
    assert (line.count(b"\n"), LslReport.decode(line)) == (1, report)


def test_trees_are_json() -> None:
    tree = (("channels", (("channel", (("label", 'a "b" \\ é'), ("type", "X"))),)), ("setup", ()))
    facts = {"name": "lab_3d"}
    assert json.loads(opening_content(facts, tree)) == json.loads(json.dumps([facts, tree]))
