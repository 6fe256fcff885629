"""The example programs that join markers and analog samples of different rates."""

import re
import sys
from collections.abc import Iterator
from typing import Any

import lcm
import numpy as np
import pytest
import rtc3d

from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from tests.example_programs import (
    EXAMPLES,
    LCM_URL,
    ExampleProgram,
    output_until_the_end,
    run_gateway,
    run_program,
)
from tests.joined_components import MARKERS, SCENARIOS, Pair, Scenario

pytestmark = pytest.mark.netns

COUNT = 60
PYTHON = ExampleProgram(
    "Python",
    (sys.executable, "join.py"),
    ("--connect", "{endpoint}", "--source", "lab", "--count", str(COUNT)),
)
CPP = ExampleProgram("C++", ("build/join",), ("LAB", str(COUNT)), target="cpp", tools=("c++", "make"))
SCENE = SyntheticScene(markers=5, tools=0, analog=2, plates=0, rate_hz=200, analog_rate_hz=2000)
LINE = re.compile(
    r"at (?P<time_s>\d+\.\d+) s: (?P<visible>\d+) markers in view \(frame (?P<frame>-?\d+)\)"
    r"(?:, (?P<count>\d+) analog samples \(frames (?P<first>-?\d+) to (?P<last>-?\d+)\),"
    r" mean of channel 1: (?P<mean>\S+))?"
)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The Zenoh endpoint of a gateway that gets markers at 200 Hz and analog channels at 2000 Hz."""
    sizes = ["--markers", "5", "--tools", "0", "--analog", "2", "--plates", "0"]
    rates = ["--rate", "200", "--analog-rate", "2000"]
    folder = tmp_path_factory.mktemp("gateway")
    with run_gateway(folder, *sizes, *rates, ready="lab (analog): connected to") as endpoint:
        yield endpoint


@pytest.mark.parametrize("program", [PYTHON, CPP], ids=str)
def test_each_frame_of_markers_is_printed_with_its_ten_analog_samples(
    endpoint: str, program: ExampleProgram
) -> None:
    program.build()
    with run_program(*program.run_command(endpoint), ready="listening") as process:
        text = output_until_the_end(process)
    assert process.returncode == 0, text
    lines = [LINE.fullmatch(line) for line in text.splitlines()]
    assert len(lines) == COUNT, text
    complete = [line for line in lines if line and line["count"] == "10"]
    assert len(complete) >= COUNT // 2  # it may hear one component before the other, and lose messages on LCM
    for line in complete:
        sample = round(float(line["time_s"]) * 2000)
        [markers] = SCENE.items(ComponentType.MARKERS, np.array([sample // 10]))
        assert int(line["visible"]) == np.count_nonzero(~np.isnan(markers["x"]))
        assert int(line["frame"]) == sample // 10 + 1
        assert (int(line["first"]), int(line["last"])) == (sample - 8, sample + 1)
        analog = SCENE.items(ComponentType.ANALOG, np.arange(sample - 9, sample + 1))
        assert float(line["mean"]) == pytest.approx(float(np.mean(analog[:, 0])), abs=2e-3)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_the_cpp_example_pairs_messages_in_any_order(scenario: Scenario) -> None:
    CPP.build()
    # The end of each scenario: a pair that shows that everything before it has been printed.
    last_us = 10_000_000
    final = [(MARKERS, last_us), ("analog", last_us), (MARKERS, last_us + 5000), ("analog", last_us + 5000)]
    connection = lcm.LCM(LCM_URL)
    with run_program(str(EXAMPLES / "build/join"), "OTHER", "0", ready="listening") as process:
        for component, timestamp_us in [*scenario.messages, *final]:
            is_frame = component == MARKERS
            message: Any = rtc3d.markers_t() if is_frame else rtc3d.analog_t()
            message.timestamp = timestamp_us
            message.frame_number = timestamp_us // 500
            connection.publish(f"MOCAP_OTHER_{'3D' if is_frame else 'ANALOG'}", message.encode())
        assert process.stdout is not None
        found = []
        for line in process.stdout:
            match = LINE.fullmatch(line.rstrip("\n"))
            assert match, line
            frame_us = int(match["frame"]) * 500
            if frame_us == last_us + 5000:
                break
            if frame_us < last_us:
                found.append((frame_us, match["first"], match["last"], match["count"]))
    assert found == [as_printed(pair) for pair in scenario.pairs]


def as_printed(pair: Pair) -> tuple[int, str | None, str | None, str | None]:
    if not pair.samples_us:
        return (pair.frame_us, None, None, None)
    numbers = [timestamp_us // 500 for timestamp_us in pair.samples_us]
    return (pair.frame_us, str(numbers[0]), str(numbers[-1]), str(len(numbers)))
