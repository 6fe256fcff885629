"""The example programs, run as a user runs them."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import lcm
import numpy as np
import pytest
import rtc3d

from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import names
from tests.support.example_programs import (
    COUNT,
    EXAMPLES,
    LCM_URL,
    PROGRAMS,
    ExampleProgram,
    output_until_the_end,
    run_gateway,
    run_program,
)
from tests.support.joined_components import MARKERS, SCENARIOS, Pair, Scenario
from tests.support.networks import free_port, open_zenoh

pytestmark = pytest.mark.netns


RATE_HZ, ANALOG_RATE_HZ = 100, 1000
SCENE = SyntheticScene(
    markers=20, tools=0, analog=2, plates=0, rate_hz=RATE_HZ, analog_rate_hz=ANALOG_RATE_HZ
)
SUBSCRIBERS = [program for program in PROGRAMS if program.arguments is not None]


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The Zenoh endpoint of a gateway that plays SCENE; like its simulator, it is a separate program."""
    folder = tmp_path_factory.mktemp("gateway")
    sizes = ("--markers", "20", "--tools", "0", "--analog", "2", "--plates", "0")
    rates = ("--rate", str(RATE_HZ), "--analog-rate", str(ANALOG_RATE_HZ))
    with run_gateway(folder, *sizes, *rates, ready="lab (analog): connected to") as endpoint:
        yield endpoint


LINE = re.compile(
    r"#(?P<sequence>\d+) frame (?P<number>\d+) at (?P<time_s>\d+\.\d+) s with parameters (?P<version>\d+):"
    r" (?P<visible>\d+) of (?P<count>\d+) markers in view, the first at"
    r" (?P<x>-?\d+\.\d+), (?P<y>-?\d+\.\d+), (?P<z>-?\d+\.\d+) mm"
)
"""A line that an example program prints for a frame."""


def assert_lines_match_the_scene(text: str) -> None:
    """Check the lines against what the simulator sends. On a busy machine, UDP loses some messages."""
    printed = [match for line in text.splitlines() if (match := LINE.fullmatch(line))]
    assert len(printed) == COUNT, text
    first = printed[0]
    assert [int(line["sequence"]) for line in printed] == sorted({int(line["sequence"]) for line in printed})
    for line in printed:
        step = int(line["sequence"]) - int(first["sequence"])
        number = int(line["number"])
        assert number == int(first["number"]) + step
        assert float(line["time_s"]) == pytest.approx(float(first["time_s"]) + step / RATE_HZ, abs=2e-4)
        assert line["version"] == "1"
        [items] = SCENE.items(ComponentType.MARKERS, np.array([number - 1]))
        visible = items[~np.isnan(items["x"])]
        assert (int(line["visible"]), int(line["count"])) == (len(visible), len(items))
        coordinates = [float(line[axis]) for axis in "xyz"]
        assert coordinates == pytest.approx([visible[0][axis] for axis in "xyz"], abs=6e-4)


@pytest.mark.parametrize("program", SUBSCRIBERS, ids=str)
def test_each_program_prints_the_markers_of_every_frame(endpoint: str, program: ExampleProgram) -> None:
    program.build()
    with run_program(*program.run_command(endpoint), ready="listening") as process:
        text = output_until_the_end(process)
    assert process.returncode == 0, text
    assert_lines_match_the_scene(text)


PAIRS = 60
JOIN = ExampleProgram(
    "Python, join",
    (sys.executable, "join.py"),
    ("--connect", "{endpoint}", "--source", "lab", "--count", str(PAIRS)),
)
CPP = ExampleProgram("C++, join", ("build/join",), ("LAB", str(PAIRS)), target="cpp", tools=("c++", "make"))


@pytest.mark.parametrize("program", [*SUBSCRIBERS, JOIN], ids=str)
def test_each_program_says_in_a_sentence_that_it_cannot_receive(program: ExampleProgram) -> None:
    program.build()
    run = subprocess.run(
        program.run_command(f"tcp/127.0.0.1:{free_port()}"), cwd=EXAMPLES, capture_output=True, text=True,
        env={**os.environ, "LCM_DEFAULT_URL": "nothing of LCM"}, check=False, timeout=120,
    )  # fmt: skip
    assert (run.returncode, run.stdout) == (1, "")
    assert re.match(r"(?i)cannot (open|receive from) (LCM|Zenoh)", run.stderr.splitlines()[-1])


@pytest.mark.parametrize("program", [program for program in PROGRAMS if program.target], ids=str)
def test_make_builds_and_runs_each_program(program: ExampleProgram) -> None:
    program.build()
    arguments = "ARGS=--help" if program.arguments else "ARGS="
    make = ["make", "-C", str(EXAMPLES), f"PYTHON={sys.executable}", f"run-{program.target}", arguments]
    text = subprocess.check_output(make, text=True, stderr=subprocess.STDOUT)
    assert re.search("Print the markers|MOCAP_LAB_3D sequence 0 at|#0 frame 1 at", text)


@pytest.mark.parametrize("name", ["subscriber_lcm.py", "subscriber_zenoh.py"])
def test_the_python_examples_ignore_malformed_messages_and_end_quietly_at_ctrl_c(name: str) -> None:
    port = free_port()
    options = ["--connect", f"tcp/127.0.0.1:{port}"] if "zenoh" in name else ["OTHER"]
    command = [sys.executable, str(EXAMPLES / name)]
    assert "usage:" in subprocess.check_output([*command, "--help"], text=True)
    connection = lcm.LCM(LCM_URL)
    with (
        open_zenoh("peer", listen=f"tcp/127.0.0.1:{port}") as session,
        run_program(*command, *options, ready="listening") as program,
    ):
        stop = threading.Event()

        def send() -> None:
            while not stop.wait(0.05):
                session.put("mocap/lab/3d", b"x")
                connection.publish("MOCAP_OTHER_3D", b"x")

        sender = threading.Thread(target=send)
        sender.start()
        assert program.stdout is not None
        line = program.stdout.readline()
        program.send_signal(signal.SIGINT)
        rest = output_until_the_end(program)
        stop.set()
        sender.join()
    assert names(line, "malformed")
    assert "Traceback" not in rest
    assert program.returncode in {0, -signal.SIGINT}


# Markers joined with analog samples of another rate --------------------------------------------

PAIR_LINE = re.compile(
    r"at (?P<time_s>\d+\.\d+) s: (?P<visible>\d+) markers in view \(frame (?P<frame>-?\d+)\)"
    r"(?:, (?P<count>\d+) analog samples \(frames (?P<first>-?\d+) to (?P<last>-?\d+)\),"
    r" mean of channel 1: (?P<mean>\S+))?"
)


@pytest.mark.parametrize("program", [JOIN, CPP], ids=str)
def test_each_frame_of_markers_is_printed_with_its_ten_analog_samples(
    endpoint: str, program: ExampleProgram
) -> None:
    program.build()
    with run_program(*program.run_command(endpoint), ready="listening") as process:
        text = output_until_the_end(process)
    assert process.returncode == 0, text
    lines = [PAIR_LINE.fullmatch(line) for line in text.splitlines()]
    assert len(lines) == PAIRS, text
    complete = [line for line in lines if line and line["count"] == "10"]
    assert complete  # it may hear one component before the other, and lose messages on LCM
    for line in complete:
        sample = round(float(line["time_s"]) * ANALOG_RATE_HZ)
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
            match = PAIR_LINE.fullmatch(line.rstrip("\n"))
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
