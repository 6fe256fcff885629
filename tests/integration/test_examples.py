"""The example programs, run as a user runs them."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lcm
import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_port, open_zenoh

pytestmark = pytest.mark.netns

ROOT = Path(__file__).parents[2]
LCM_URL = "udpm://239.255.76.67:7712?ttl=0"
PROGRAM = [sys.executable, "-m", "gateway"]


@contextmanager
def run_program(*command: str, ready: str) -> Iterator[subprocess.Popen[str]]:
    """Start a program, wait for ``ready`` in its output, and end it after the block."""
    environment = {**os.environ, "LCM_DEFAULT_URL": LCM_URL}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if ready in line:
                    break
            else:
                raise AssertionError(f"{command} ended without {ready!r}")
            yield process
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The Zenoh endpoint of a gateway that runs, like its simulator, as a separate program."""
    port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path_factory.mktemp("gateway") / "gateway.yaml"
    config.write_text(
        f"""
        sources: [{{name: lab, host: 127.0.0.1, port: {port}}}]
        zenoh:
          config: {{listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}
        """
    )
    simulate = [*PROGRAM, "simulate", "--port", str(port), "--markers", "20", "--rate", "100"]
    gateway = [*PROGRAM, "run", "--config", str(config), "--log-level", "debug"]
    with (
        run_program(*simulate, ready="RTC3D server on"),
        run_program(*gateway, ready="zenoh: the session is open"),
    ):
        yield endpoint


def printed_positions(text: str) -> list[tuple[int, list[float]]]:
    """Return the number and the first position of each printed frame with version 1 of the parameters."""
    found = re.findall(
        r"frame (\d+) with parameters 1:[^\n]*?(?:\n[^#\n]*?)?(-?\d+\.\d+),\s?(-?\d+\.\d+),\s?(-?\d+\.\d+)",
        text,
    )
    return [(int(number), [float(value) for value in position]) for number, *position in found]


def assert_positions_match_the_scene(text: str, at_least: int) -> None:
    scene = SyntheticScene(markers=20, tools=4, analog=16, plates=2, rate_hz=100, analog_rate_hz=2000)
    printed = printed_positions(text)
    assert len(printed) >= at_least
    for number, position in printed:
        [items] = scene.items(ComponentType.MARKERS, np.array([number - 1]))
        first = items[~np.isnan(items["x"])][0]
        assert position == pytest.approx([first["x"], first["y"], first["z"]], abs=6e-4)


def test_the_c_example_prints_positions_from_lcm(endpoint: str, tmp_path: Path) -> None:  # noqa: ARG001
    if shutil.which("cc") is None or shutil.which("make") is None:
        pytest.skip("no C compiler here (cc, make)")
    build = subprocess.run(
        ["make", "-C", str(ROOT / "examples"), f"PYTHON={sys.executable}", f"BUILD={tmp_path}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert build.returncode == 0, build.stderr
    with run_program(str(tmp_path / "subscriber"), "LAB", "20", ready="listening") as program:
        text = program.communicate(timeout=30)[0]
    assert_positions_match_the_scene(text.replace(" missing", ""), 15)
    assert program.returncode == 0


def test_the_python_example_prints_positions_from_lcm(endpoint: str) -> None:  # noqa: ARG001
    command = [sys.executable, str(ROOT / "examples/subscriber_lcm.py"), "LAB", "20"]
    with run_program(*command, ready="listening") as program:
        assert_positions_match_the_scene(program.communicate(timeout=30)[0], 15)


def test_the_python_example_prints_positions_from_zenoh(endpoint: str) -> None:
    command = [
        sys.executable,
        str(ROOT / "examples/subscriber_zenoh.py"),
        "--connect",
        endpoint,
        "--count",
        "20",
    ]
    with run_program(*command, ready="listening") as program:
        assert_positions_match_the_scene(program.communicate(timeout=30)[0], 15)


@pytest.mark.parametrize("name", ["subscriber_lcm.py", "subscriber_zenoh.py"])
def test_the_python_examples_ignore_malformed_messages_and_end_quietly_at_ctrl_c(name: str) -> None:
    port = free_port()
    options = ["--connect", f"tcp/127.0.0.1:{port}"] if "zenoh" in name else ["OTHER"]
    command = [sys.executable, str(ROOT / "examples" / name)]
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
        rest = program.communicate(timeout=30)[0]
        stop.set()
        sender.join()
    assert line.startswith("ignored a malformed message: ")
    assert "Traceback" not in rest
    assert program.returncode in {0, -signal.SIGINT}
