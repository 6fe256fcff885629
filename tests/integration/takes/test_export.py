"""``rtc3d-gateway export`` as a user types it: what it prints, and which files are there afterwards."""

import errno
import os
import re
import resource
import signal
import subprocess
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import yaml

from gateway.outputs.zenoh.output import TEXTS
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import ForceChannel, Parameters, ParametersForce, Plate
from gateway.runtime.quantities import size_text
from gateway.simulator.synthetic import SyntheticScene
from tests.support.commands import run_in_process
from tests.support.errors import names as names_values
from tests.support.gateway_process import PROGRAM
from tests.support.networks import free_endpoint, free_port, zenoh_keys
from tests.support.takes import frame, parameters, record_scene, write_take
from tests.support.waiting import wait_until
from tests.unit.takes.export.exported import read_ezc3d

SCENE = SyntheticScene(markers=20, tools=0, analog=8, plates=1, rate_hz=100, analog_rate_hz=1000)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_scene(tmp_path_factory.mktemp("take") / "walk.lcmlog", SCENE, 500)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_it_prints_the_files_and_what_was_left_out(take: Path, tmp_path: Path) -> None:
    done = run_in_process("export", take, tmp_path / "walk.c3d")
    size = size_text((tmp_path / "walk.c3d").stat().st_size)
    assert done[:2] == (0, f"{tmp_path}/walk.c3d ({size})\n")
    assert any(re.fullmatch("walk.c3d\tforces .*\t1", line) for line in done.stderr.splitlines())
    content = bytearray(take.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 3000] = bytes(3000)
    (tmp_path / "damaged.lcmlog").write_bytes(content[:-100])
    done = run_in_process("export", tmp_path / "damaged.lcmlog", tmp_path / "DAMAGED.MCAP")
    assert done.returncode == 0
    assert names_values(done.stderr, "2 places")


WALK = Path(__file__).parents[3] / "examples/walk.lcmlog"
BIDS = ("--bids", "--subject", "01", "--task", "walking")


def test_a_bids_data_set_is_a_folder_that_grows(tmp_path: Path) -> None:
    study = tmp_path / "study"
    done = run_in_process("export", WALK, study, *BIDS)
    assert done.returncode == 0
    assert f"{study}/sub-01/sub-01_scans.tsv (" in done.stdout
    assert names_values(done.stderr, "mm to m")
    done = run_in_process("export", WALK, study, *BIDS, "--session", "2", "--run", "3")
    assert f"{study}/sub-01/ses-2/sub-01_ses-2_scans.tsv (" in done.stdout
    assert len(list(study.rglob("*_run-3_motion.tsv"))) == 4


def test_who_and_what_the_take_is_about_can_be_replaced(tmp_path: Path) -> None:
    done = run_in_process(
        "export", WALK, tmp_path / "a.csv", "--subject", "S1", "--session", "", "--note", " x "
    )
    [line] = done.stderr.splitlines()
    assert names_values(line, "lab", "subject, note")
    done = run_in_process("export", WALK, tmp_path / "a.c3d", "--subject", "S" * 65)
    assert done.returncode == 2
    assert names_values(done.stderr, "64 characters")


EXISTS = "exists already"


@pytest.mark.parametrize(
    ("name", "options", "problem", "status"),
    [
        (
            "walk.xyz",
            (),
            ".c3d, .trc, .mot, .sto, .csv, .parquet or .mcap",
            2,
        ),
        ("walk", (), "--opensim or --bids", 2),
        *((f"walk{each}", (), EXISTS, 1) for each in (".c3d", ".csv", ".trc", ".mcap")),
        ("missing/a.csv", (), "create it", 1),
        ("a.trc", ("--source", "studio"), "'studio'", 2),
        ("a.trc", ("--from", "3000"), "has no markers", 2),
        ("a.csv", ("--forward", "-x"), ".trc, .mot or --opensim", 2),
        ("a.mot", ("--bodies", "calcn_r"), "--bodies", 2),
        ("a.c3d", ("--task", "x"), "--task", 2),
        (
            "a",
            ("--opensim", "--bodies", "toes, ,heel"),
            "walk.mot: 1, not 2",
            2,
        ),
        ("walk", ("--opensim",), EXISTS, 1),
        ("a.mot", ("--opensim",), "omit .mot", 2),
    ],
)
def test_what_cannot_be_exported_leaves_no_file(
    take: Path, tmp_path: Path, name: str, options: tuple[str, ...], problem: str, status: int
) -> None:
    existing = [f"walk{extension}" for extension in ("", "-analog.csv", ".c3d", ".mcap", ".trc")]
    for each in existing:
        (tmp_path / each).write_text("mine")
    done = run_in_process("export", take, tmp_path / name, *options)
    assert (done.returncode, done.stdout) == (status, "")
    assert problem in done.stderr
    assert names(tmp_path) == existing
    assert {(tmp_path / each).read_text() for each in existing} == {"mine"}


def test_bad_input_is_a_sentence_with_the_name_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.lcmlog").write_bytes(b"no event log" * 1000)
    (tmp_path / "b.lcmlog").touch()
    (tmp_path / "folder").mkdir()
    for name in ("a.lcmlog", "b.lcmlog", "folder", "missing.lcmlog"):
        done = run_in_process("export", tmp_path / name, tmp_path / "walk.c3d")
        assert (done.returncode, done.stdout) == (1, "")
        assert str(tmp_path / name) in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("*walk*"))


@pytest.mark.parametrize("extension", ["csv", "parquet"])
def test_an_export_that_is_stopped_or_whose_disk_is_full_leaves_no_file(
    tmp_path: Path, extension: str
) -> None:
    """Half a file would be taken for the whole one. The take is a folder with the same file many times."""
    scene = SyntheticScene(markers=300, tools=0, analog=200, plates=0, rate_hz=100, analog_rate_hz=1000)
    (tmp_path / "long.lcmlog").mkdir()
    recording = record_scene(tmp_path / "long.lcmlog/0.lcmlog", scene, 200)
    for number in range(1, 20):
        recording.with_name(f"{number}.lcmlog").hardlink_to(recording)
    command = [*PROGRAM, "export", str(tmp_path / "long.lcmlog"), str(tmp_path / f"long.{extension}")]
    with subprocess.Popen(command) as process:
        wait_until(lambda: len(names(tmp_path)) > 1)
        process.send_signal(signal.SIGINT)
    assert process.returncode == 130
    assert names(tmp_path) == ["long.lcmlog"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as full:
        resource.prlimit(full.pid, resource.RLIMIT_FSIZE, (50_000, 50_000))
        _, stderr = full.communicate(timeout=60)
    assert full.returncode == 1
    assert names_values(stderr, os.strerror(errno.EFBIG), "nothing")
    assert names(tmp_path) == ["long.lcmlog"]


def test_names_from_a_server_cannot_leave_the_folder_or_control_the_terminal(tmp_path: Path) -> None:
    evil = Parameters(force=ParametersForce((Plate("1", "\x1b[2J../x", channels=(ForceChannel("1"),)),)))
    messages = [parameters(evil), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    take = write_take(tmp_path / "take.lcmlog", messages)
    done = run_in_process("export", take, tmp_path / "walk.c3d")
    assert done.returncode == 0
    assert "\x1b" not in done.stderr
    assert names(tmp_path) == ["take.lcmlog", "walk.c3d"]


@pytest.mark.netns
@pytest.mark.takes
def test_a_c3d_file_keeps_its_values_through_simulator_gateway_record_and_export(tmp_path: Path) -> None:
    """The export of its other fields is proved without processes, in tests/unit/export."""
    original = Path(os.environ["RTC3D_TAKES"]) / "qualisys.c3d"
    take, copy, config = (tmp_path / name for name in ("take.lcmlog", "copy.c3d", "lab.yaml"))
    port, endpoint = free_port(), free_endpoint()
    reconnect = {"max_delay_s": 0.2}
    configuration = {
        "sources": [{"name": "lab", "host": "127.0.0.1", "port": port, "reconnect": reconnect}],
        "zenoh": {"config": zenoh_keys("peer", listen=endpoint)},
        "lcm": {"enabled": False},
        "metrics": {"enabled": False},
    }
    config.write_text(yaml.safe_dump(configuration))

    with ExitStack() as stack:

        def start(*arguments: str | Path) -> subprocess.Popen[bytes]:
            file = stack.enter_context((tmp_path / f"{arguments[0]}.log").open("wb"))
            process = subprocess.Popen([*PROGRAM, *arguments], stdout=file, stderr=subprocess.STDOUT)
            stack.callback(process.wait, 30)
            stack.callback(process.send_signal, signal.SIGINT)
            return process

        def wait_for(command: str, text: str) -> None:
            wait_until(lambda: text in (tmp_path / f"{command}.log").read_text())

        start("run", "--config", config)
        wait_for("run", f"zenoh: {TEXTS.opened}")
        record = start("record", take, "--connect", endpoint)
        wait_for("record", "gets no frames")  # it receives the gateway's status
        start("simulate", "--c3d", original, "--once", "--port", str(port))
        expected_counts = {b"MOCAP_LAB_3D": 340, b"MOCAP_LAB_ANALOG": 3400}
        for channel, count in expected_counts.items():
            wait_until(lambda: take.exists() and take.read_bytes().count(channel) == count, 60)  # noqa: B023
        wait_until(lambda: b"MOCAP_LAB_PARAMETERS" in take.read_bytes())  # late on a busy machine
        record.send_signal(signal.SIGINT)
        assert record.wait(30) == 0
    assert names_values(run_in_process("export", take, copy).stderr, "time 0")
    expected, found = (read_ezc3d(path) for path in (original, copy))
    events = [content["parameters"]["EVENT"] for content in (expected, found)]
    assert events[0]["LABELS"]["value"] == events[1]["LABELS"]["value"]
    starts_s = [content["header"]["points"]["first_frame"] / 200 for content in (expected, found)]
    times_s = [event["TIMES"]["value"][1] - start_s for event, start_s in zip(events, starts_s, strict=True)]
    assert times_s[0] == pytest.approx(times_s[1], abs=1e-4)
    for group in ("POINT", "ANALOG"):
        for name in ("LABELS", "RATE"):
            values = (each["parameters"][group][name]["value"] for each in (found, expected))
            assert np.array_equal(*values), name
    for key in ("points", "analogs"):
        ours, theirs = (np.float32(each["data"][key]) for each in (found, expected))
        assert np.array_equal(ours, theirs, equal_nan=True)
