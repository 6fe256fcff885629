"""LSL as its users see it: pylsl's inlets in another process, and the file that LabRecorder writes."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import numpy as np
import pytest
import pyxdf

from tests.support.commands import run_command
from tests.support.configurations import write_config
from tests.support.gateway_process import program, simulator
from tests.support.lsl_receiver import LslReceiver, lsl_config
from tests.support.waiting import wait_until
from tests.support.xdf import RecordedStream, write_xdf

pytestmark = pytest.mark.netns

NAMES: Final = ("lab_3d", "lab_6d", "lab_analog", "lab_force", "lab_event")
RATE_HZ: Final = 100
ANALOG_RATE_HZ: Final = 1000
SCENE: Final = (
    *("--rate", str(RATE_HZ), "--analog-rate", str(ANALOG_RATE_HZ)),
    *("--markers", "4", "--tools", "2", "--analog", "3", "--plates", "1"),
)
TIMEOUT_S: Final = 120.0
WAITING_S: Final = 3.0
"""How long no gateway runs: longer than the first searches of liblsl, which come in quick succession."""


class Lab:
    """A gateway with LSL and one source. ``config`` is the file of liblsl."""

    def __init__(self, folder: Path, port: int) -> None:
        self.config = lsl_config(folder)
        lsl = {"enabled": True, "config": str(self.config)}
        self.file = write_config(folder / "gateway.yaml", port, lsl=lsl)
        self.log_file = folder / "gateway.log"
        self._exit = ExitStack()
        self._gateway = self._exit.enter_context(ExitStack())

    def start(self) -> None:
        log = self._gateway.enter_context(self.log_file.open("wb"))
        self._gateway.enter_context(program("run", "--config", str(self.file), stderr=log))

    def stop(self) -> None:
        self._gateway.close()

    def receive(self, *names: str) -> LslReceiver:
        """Connect a receiver, and wait until it has the streams."""
        receiver = LslReceiver(self.config, *names)
        self._exit.callback(receiver.close)
        wait_until(lambda: set(names) <= set(receiver.xml), TIMEOUT_S)
        return receiver

    def close(self) -> None:
        self._exit.close()


@contextmanager
def running(folder: Path) -> Iterator[Lab]:
    with simulator(*SCENE) as (port, _):
        lab = Lab(folder, port)
        lab.start()
        try:
            yield lab
        finally:
            lab.close()


def has(receiver: LslReceiver, name: str, count: int) -> Callable[[], bool]:
    return lambda: len(receiver.samples[name]) >= count


def receive_until_the_clock_is_known(receiver: LslReceiver) -> None:
    """Forget the samples of the first 2 s: until the server's clock is known, their times are of arrival."""
    wait_until(has(receiver, "lab_3d", 2 * RATE_HZ), TIMEOUT_S)
    receiver.forget()


def test_a_recording_has_labels_units_rates_and_capture_times(tmp_path: Path) -> None:
    with running(tmp_path) as lab:
        began_s = time.monotonic()
        receiver = lab.receive(*NAMES)
        receive_until_the_clock_is_known(receiver)
        wait_until(lambda: all(has(receiver, name, 4)() for name in NAMES), TIMEOUT_S)
        wait_until(has(receiver, "lab_analog", 3 * ANALOG_RATE_HZ), TIMEOUT_S)
        ended_s = time.monotonic()
    file = tmp_path / "recording.xdf"
    streams = [
        RecordedStream(receiver.xml[name], [(began_s, receiver.offset_s[name])], receiver.samples[name])
        for name in NAMES
    ]
    write_xdf(file, streams)
    read, _ = pyxdf.load_xdf(str(file))
    found = {stream["info"]["name"][0]: stream for stream in read}
    rates_hz = {name: float(stream["info"]["nominal_srate"][0]) for name, stream in found.items()}
    assert rates_hz == dict(zip(NAMES, [RATE_HZ, RATE_HZ, ANALOG_RATE_HZ, ANALOG_RATE_HZ, 0], strict=True))
    for name, rate_hz in rates_hz.items():
        stream = found[name]
        if rate_hz:  # frames may be missing on a busy computer
            captured_s = [time_s for time_s, _ in receiver.samples[name]]
            assert np.median(np.diff(captured_s)) == pytest.approx(1 / rate_hz, rel=0.01)
        times_s = stream["time_stamps"]
        # On one computer, LSL's clock is the monotonic one: samples were captured before they arrived.
        assert began_s < times_s[0] <= times_s[-1] < ended_s
        channels = stream["info"]["desc"][0]["channels"][0]["channel"]
        assert len(channels) == int(stream["info"]["channel_count"][0])
    [markers] = found["lab_3d"]["info"]["desc"][0]["setup"][0]["markers"]
    assert len(markers["marker"]) == 4
    assert all(text.startswith("Button: ") for [text] in found["lab_event"]["time_series"])
    positions = found["lab_3d"]["time_series"][:, :3]
    assert np.nanmax(abs(positions)) < 5  # metres
    quaternions = found["lab_6d"]["time_series"][:, 3:7]
    lengths = np.linalg.norm(quaternions[~np.isnan(quaternions).any(axis=1)], axis=1)
    assert lengths == pytest.approx(np.ones_like(lengths), abs=1e-3)


def test_receivers_that_wait_continue_with_all_streams_of_the_next_gateway(tmp_path: Path) -> None:
    """With ResolveScope = machine alone, they find one of five."""
    with running(tmp_path) as lab:
        receiver = lab.receive(*NAMES)
        wait_until(lambda: all(has(receiver, name, 1)() for name in NAMES), TIMEOUT_S)
        assert doctors_results(lab) == {"opens": "green", "found": "green", "gateway": "green"}
        lab.stop()
        time.sleep(WAITING_S)
        receiver.forget()
        lab.start()
        wait_until(lambda: all(has(receiver, name, 1)() for name in NAMES), TIMEOUT_S)


def doctors_results(lab: Lab) -> dict[str, str]:
    """Return the results of the doctor's checks of LSL."""
    findings = json.loads(run_command("doctor", "--config", lab.file, "--json").stdout)["findings"]
    return {each["check"]: each["result"] for each in findings if each["subject"] == "lsl"}
