"""The five programs of docs/how-to/live-python.md, as printed there, with a gateway and simulators."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.support.documents import blocks
from tests.support.example_programs import EXAMPLES
from tests.support.gateway_process import program, simulator
from tests.support.networks import free_endpoint, zenoh_keys
from tests.support.waiting import wait_until

PAGE = "docs/how-to/live-python.md"
ENDLESS = {
    "live_marker.py": "Marker 1 at ",
    "live_plot.py": "plotting Force plate 1",
    "live_control.py": "Tool 1 at ",
    "live_two_sources.py": " mm apart, ",
}
_COUNTS = ("--markers", "3", "--tools", "1", "--analog", "2", "--plates", "1")
SIMULATED = (*_COUNTS, "--rate", "100", "--analog-rate", "200")


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The Zenoh endpoint of a gateway with the sources lab and stage."""
    folder, endpoint = tmp_path_factory.mktemp("gateway"), free_endpoint()
    with simulator(*SIMULATED) as (lab, _), simulator(*SIMULATED) as (stage, _):
        sources = [
            {"name": name, "host": "127.0.0.1", "port": port}
            for name, port in (("lab", lab), ("stage", stage))
        ]
        off = {name: {"enabled": False} for name in ("lcm", "metrics")}
        zenoh = {"config": zenoh_keys("peer", listen=endpoint)}
        config = folder / "gateway.yaml"
        config.write_text(yaml.safe_dump({"sources": sources, "zenoh": zenoh, **off}))
        log = folder / "gateway.log"
        with log.open("wb") as stderr, program("run", "--config", str(config), stderr=stderr):
            wait_until(lambda: log.read_text().count(": a frame arrived") >= 4)
            yield endpoint


def run(name: str, *arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def interrupted(process: "subprocess.Popen[str]", text: str) -> tuple[int, str]:
    """Send one Ctrl-C when the program has printed ``text``; return its exit status and its output."""
    with process:
        assert process.stdout is not None
        printed = []
        try:
            for line in process.stdout:
                printed.append(line)
                if text in line and "nan" not in line:
                    process.send_signal(signal.SIGINT)
                    printed.append(process.communicate(timeout=120)[0])
                    return process.returncode, "".join(printed)
        finally:
            process.kill()
    pytest.fail("".join(printed))


@pytest.mark.parametrize("name", [*ENDLESS, "live_record.py"])
def test_the_page_has_the_program_as_it_is(name: str) -> None:
    assert (EXAMPLES / name).read_text() in [block.text for block in blocks(PAGE, "python")]


@pytest.mark.netns
@pytest.mark.parametrize("name", ENDLESS)
def test_a_program_prints_live_data_and_ends_by_one_ctrl_c(name: str, endpoint: str) -> None:
    status, output = interrupted(run(name, endpoint), ENDLESS[name])
    assert status == -signal.SIGINT, output
    assert output.endswith("KeyboardInterrupt\n")


@pytest.mark.netns
@pytest.mark.parametrize("name", ["join.py", "subscriber_zenoh.py"])
def test_a_program_without_the_client_ends_by_one_ctrl_c(name: str, endpoint: str) -> None:
    status, output = interrupted(run(name, "--connect", endpoint), "listening")
    assert status == 0
    assert "Traceback" not in output


@pytest.mark.netns
@pytest.mark.parametrize("page", ["README.md", PAGE])
def test_the_first_program_of_a_page_ends_by_one_ctrl_c(page: str, endpoint: str, tmp_path: Path) -> None:
    """The program is as printed; only the network namespace needs the endpoint."""
    [*_, program] = [block.text for block in blocks(page, "python")][:1]
    config = tmp_path / "zenoh.json5"
    file = tmp_path / "program.py"
    config.write_text(json.dumps(zenoh_keys("client", connect=endpoint)))
    options = f'components=["3d"], zenoh_config="{config}")'
    file.write_text(program.replace('components=["3d"])', options))
    status, output = interrupted(run(str(file)), " ")
    assert status == -signal.SIGINT
    assert output.endswith("KeyboardInterrupt\n")


@pytest.mark.netns
def test_the_recorder_saves_what_it_has_received(endpoint: str, tmp_path: Path) -> None:
    with run("live_record.py", str(tmp_path / "a.npz"), endpoint) as process:
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "0 messages were dropped" in output
    saved = np.load(tmp_path / "a.npz")
    assert saved["lab_3d_labels"].tolist() == ["Marker 1", "Marker 2", "Marker 3"]
    assert saved["lab_3d_items"].shape == (len(saved["lab_3d_seconds"]), 3)
    assert len(saved["lab_3d_seconds"]) > 100
