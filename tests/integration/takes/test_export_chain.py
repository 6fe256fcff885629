"""A C3D file through simulator, gateway, ``record`` and ``export`` to a C3D file that has the same values."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.gateway_process import PROGRAM
from tests.networks import free_endpoint, free_port, zenoh_keys
from tests.unit.export.exported import read_ezc3d, read_independently
from tests.waiting import wait_until

pytestmark = [pytest.mark.netns, pytest.mark.takes]


class Lab:
    """Programs that run until the end of the test; their output is in files."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self._stack = stack

    def start(self, *arguments: str | Path) -> subprocess.Popen[bytes]:
        """Start a command, whose output ``output`` returns."""
        file = self._stack.enter_context((self.folder / f"{arguments[0]}.log").open("wb"))
        process = subprocess.Popen([*PROGRAM, *map(str, arguments)], stdout=file, stderr=subprocess.STDOUT)
        self._stack.callback(process.wait, 30)
        self._stack.callback(process.send_signal, signal.SIGINT)
        return process

    def output(self, command: str) -> str:
        return (self.folder / f"{command}.log").read_text()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(tmp_path, stack)


def float32(values: Any) -> Any:
    return np.asarray(values).astype(np.float32)


def recorded(take: Path, component: str) -> int:
    """Return how many messages of a component are in a take, which may still be written."""
    return take.read_bytes().count(f"MOCAP_LAB_{component}".encode()) if take.exists() else 0


@pytest.mark.parametrize(
    ("name", "num_frames", "num_samples"), [("qualisys", 340, 3400), ("optotrak", 29, 0)]
)
def test_the_exported_file_has_what_the_original_has(
    lab: Lab, name: str, num_frames: int, num_samples: int
) -> None:
    original = Path(os.environ["RTC3D_TAKES"]) / f"{name}.c3d"
    port, endpoint = free_port(), free_endpoint()
    configuration = {
        "sources": [{"name": "lab", "host": "127.0.0.1", "port": port, "reconnect": {"max_delay_s": 0.2}}],
        "zenoh": {"config": zenoh_keys("peer", listen=endpoint)},
        "lcm": {"enabled": False},
        "metrics": {"enabled": False},
    }
    (lab.folder / "lab.yaml").write_text(yaml.safe_dump(configuration))
    take, copy = lab.folder / "take.lcmlog", lab.folder / "copy.c3d"
    lab.start("run", "--config", lab.folder / "lab.yaml")
    wait_until(lambda: "zenoh: the session is open" in lab.output("run"))
    record = lab.start("record", take, "--connect", endpoint)
    wait_until(lambda: "gets no frames" in lab.output("record"))  # it receives the gateway's status
    lab.start("simulate", "--c3d", original, "--once", "--port", str(port))
    wait_until(lambda: recorded(take, "3D") == num_frames and recorded(take, "ANALOG") == num_samples, 60)
    record.send_signal(signal.SIGINT)
    assert record.wait(30) == 0, lab.output("record")
    export = subprocess.run([*PROGRAM, "export", take, copy], capture_output=True, text=True, check=True)
    assert export.stderr == ""

    expected, found = read_ezc3d(original), read_ezc3d(copy)
    for group, parameters in {
        "POINT": ("LABELS", "DESCRIPTIONS", "RATE", "FRAMES"),
        "ANALOG": ("LABELS", "DESCRIPTIONS", "UNITS", "RATE"),
        "FORCE_PLATFORM": ("USED", "TYPE", "CHANNEL", "CORNERS"),
    }.items():
        for parameter in parameters:
            assert np.array_equal(
                found["parameters"][group][parameter]["value"],
                expected["parameters"][group][parameter]["value"],
            ), parameter
    for key in ("points", "analogs"):
        assert np.array_equal(float32(found["data"][key]), float32(expected["data"][key]), equal_nan=True)
    for ours, theirs in zip(found["data"]["platform"], expected["data"]["platform"], strict=True):
        for field in ("force", "moment", "center_of_pressure"):
            assert np.array_equal(ours[field], theirs[field], equal_nan=True)
    mine, others = read_independently(copy), read_independently(original)
    assert np.array_equal(mine.is_visible, others.is_visible)
    assert np.array_equal(mine.points[mine.is_visible][:, :3], others.points[others.is_visible][:, :3])
    assert np.array_equal(mine.analog, others.analog)
    assert (mine.labels, mine.point_rate_hz, mine.analog_rate_hz) == (
        others.labels,
        others.point_rate_hz,
        others.analog_rate_hz,
    )
