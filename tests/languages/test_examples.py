"""The example programs, run as a user runs them."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import lcm
import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from tests.example_programs import (
    COUNT,
    EXAMPLES,
    LCM_URL,
    PROGRAMS,
    ExampleProgram,
    output_until_the_end,
    run_gateway,
    run_program,
)
from tests.networks import free_port, open_zenoh

pytestmark = pytest.mark.netns


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The Zenoh endpoint of a gateway that runs, like its simulator, as a separate program."""
    folder = tmp_path_factory.mktemp("gateway")
    with run_gateway(
        folder, "--markers", "20", "--rate", "100", ready="zenoh: the session is open"
    ) as endpoint:
        yield endpoint


LINE = re.compile(
    r"#(?P<sequence>\d+) frame (?P<number>\d+) at (?P<time_s>\d+\.\d+) s with parameters (?P<version>\d+):"
    r" (?P<visible>\d+) of (?P<count>\d+) markers in view, the first at"
    r" (?P<x>-?\d+\.\d+), (?P<y>-?\d+\.\d+), (?P<z>-?\d+\.\d+) mm"
)
"""A line that an example program prints for a frame."""


def assert_lines_match_the_scene(text: str) -> None:
    """Check the lines against what the simulator sends. On a busy machine, UDP loses some messages."""
    scene = SyntheticScene(markers=20, tools=4, analog=16, plates=2, rate_hz=100, analog_rate_hz=2000)
    printed = [match for line in text.splitlines() if (match := LINE.fullmatch(line))]
    assert len(printed) == COUNT, text
    first = printed[0]
    assert [int(line["sequence"]) for line in printed] == sorted({int(line["sequence"]) for line in printed})
    for line in printed:
        step = int(line["sequence"]) - int(first["sequence"])
        number = int(line["number"])
        assert number == int(first["number"]) + step
        assert float(line["time_s"]) == pytest.approx(float(first["time_s"]) + step / 100, abs=2e-4)
        assert line["version"] == "1"
        [items] = scene.items(ComponentType.MARKERS, np.array([number - 1]))
        visible = items[~np.isnan(items["x"])]
        assert (int(line["visible"]), int(line["count"])) == (len(visible), len(items))
        coordinates = [float(line[axis]) for axis in "xyz"]
        assert coordinates == pytest.approx([visible[0][axis] for axis in "xyz"], abs=6e-4)


@pytest.mark.parametrize(
    "program", [program for program in PROGRAMS if program.arguments is not None], ids=str
)
def test_each_program_prints_the_markers_of_every_frame(endpoint: str, program: ExampleProgram) -> None:
    program.build()
    with run_program(*program.run_command(endpoint), ready="listening") as process:
        text = output_until_the_end(process)
    assert process.returncode == 0, text
    assert_lines_match_the_scene(text)


JOIN = ExampleProgram("join.py", (sys.executable, "join.py"), ("--connect", "{endpoint}"))


@pytest.mark.parametrize(
    "program", [*(program for program in PROGRAMS if program.arguments is not None), JOIN], ids=str
)
def test_each_program_says_in_a_sentence_that_it_cannot_receive(program: ExampleProgram) -> None:
    program.build()
    run = subprocess.run(
        program.run_command(f"tcp/127.0.0.1:{free_port()}"), cwd=EXAMPLES, capture_output=True, text=True,
        env={**os.environ, "LCM_DEFAULT_URL": "nothing of LCM"}, check=False, timeout=30,
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
    assert line.startswith("ignored a malformed message: ")
    assert "Traceback" not in rest
    assert program.returncode in {0, -signal.SIGINT}
