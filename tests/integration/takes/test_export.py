"""``rtc3d-gateway export`` as a user types it: what it prints, and which files are there afterwards."""

import resource
import signal
import subprocess
from pathlib import Path

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import ForceChannel, Parameters, ParametersForce, Plate
from gateway.simulator.synthetic import SyntheticScene
from tests.command_in_process import Ended, run_in_process
from tests.gateway_process import PROGRAM
from tests.recorded_scenes import record_scene
from tests.takes import frame, parameters, write_take
from tests.unit.export.exported import read_ezc3d
from tests.waiting import wait_until

SCENE = SyntheticScene(markers=20, tools=0, analog=8, plates=1, rate_hz=100, analog_rate_hz=1000)
EXTENSIONS = (".c3d", ".trc", ".csv", ".mcap")


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_scene(tmp_path_factory.mktemp("take") / "walk.lcmlog", SCENE, 500)


def export(*arguments: Path | str, max_file_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    def limit_files() -> None:
        if max_file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (max_file_bytes, max_file_bytes))

    return subprocess.run(
        [*PROGRAM, "export", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=limit_files,
    )


def refused(*arguments: Path | str) -> Ended:
    """Run an export that is refused before it writes."""
    return run_in_process("export", *arguments)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_it_prints_the_files_and_what_was_left_out(take: Path, tmp_path: Path) -> None:
    done = export(take, tmp_path / "walk.c3d")
    assert (done.returncode, done.stderr) == (0, "")
    size = (tmp_path / "walk.c3d").stat().st_size
    assert done.stdout == f"{tmp_path}/walk.c3d ({size / 1e6:.1f} MB)\n"
    done = export(take, tmp_path / "part.C3D", "--from", "1.001", "--to", "2.001")
    assert done.returncode == 0
    assert "note: " in done.stderr
    assert read_ezc3d(tmp_path / "part.C3D")["data"]["points"].shape[2] in {99, 100}


def test_an_unknown_extension_is_an_error_that_lists_the_known_ones(take: Path, tmp_path: Path) -> None:
    for name in ("walk.xyz", "walk"):
        done = refused(take, tmp_path / name)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr.endswith(f"{name} has no known extension; choose .c3d, .trc, .csv or .mcap\n")
    assert names(tmp_path) == []


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_what_exists_is_never_overwritten(take: Path, tmp_path: Path, extension: str) -> None:
    existing = tmp_path / ("walk-analog.csv" if extension == ".csv" else f"walk{extension}")
    existing.write_text("mine")
    done = refused(take, tmp_path / f"walk{extension}")
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{existing} exists already, and nothing is overwritten" in done.stderr
    assert names(tmp_path) == [existing.name]
    assert existing.read_text() == "mine"


def test_an_export_that_is_stopped_leaves_no_file(tmp_path: Path) -> None:
    scene = SyntheticScene(markers=300, tools=0, analog=200, plates=0, rate_hz=100, analog_rate_hz=1000)
    record_scene(tmp_path / "long.lcmlog", scene, 1000)
    process = subprocess.Popen([*PROGRAM, "export", tmp_path / "long.lcmlog", tmp_path / "long.csv"])
    wait_until(lambda: len(names(tmp_path)) > 1)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) == 130
    assert names(tmp_path) == ["long.lcmlog"]


def test_a_full_disk_leaves_no_file(take: Path, tmp_path: Path) -> None:
    """Half a file would be taken for the whole one."""
    done = export(take, tmp_path / "walk.csv", max_file_bytes=50_000)
    assert (done.returncode, done.stdout) == (1, "")
    [*notes, error] = done.stderr.splitlines()
    assert error.endswith("cannot be written: File too large; nothing was written")
    assert all(note.startswith("note: ") for note in notes)
    assert names(tmp_path) == []


def test_bad_input_is_a_sentence(tmp_path: Path) -> None:
    """The user learns which file is meant, without a traceback."""
    foreign, empty, folder = tmp_path / "a.lcmlog", tmp_path / "b.lcmlog", tmp_path / "folder"
    foreign.write_bytes(b"no event log" * 1000)
    empty.touch()
    folder.mkdir()
    for take in (foreign, empty, folder, tmp_path / "missing.lcmlog"):
        done = refused(take, tmp_path / "walk.c3d")
        assert (done.returncode, done.stdout) == (1, "")
        assert str(take) in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("*walk*"))


def test_a_damaged_take_is_exported_with_a_note(take: Path, tmp_path: Path) -> None:
    """What can be read is worth having; the user must know that it is not all."""
    content = bytearray(take.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 3000] = bytes(3000)
    damaged = tmp_path / "damaged.lcmlog"
    damaged.write_bytes(content[:-100])
    done = run_in_process("export", damaged, tmp_path / "walk.mcap")
    assert done.returncode == 0
    assert "note: the take is damaged at 2 places: " in done.stderr


def test_a_wrong_source_or_time_is_an_error(take: Path, tmp_path: Path) -> None:
    for options, text in (
        (("--source", "studio"), "has no source 'studio'; its sources are: lab"),
        (("--from", "3", "--to", "2"), "--from 3 is not before --to 2"),
        (("--from", "3000"), "has no markers"),
    ):
        assert text in refused(take, tmp_path / "a.trc", *options).stderr
    assert names(tmp_path) == []


def test_a_folder_that_is_missing_is_an_error(take: Path, tmp_path: Path) -> None:
    done = refused(take, tmp_path / "missing/walk.csv")
    assert done.stderr.endswith("cannot be written: No such file or directory; nothing was written\n")


def test_names_from_a_server_cannot_leave_the_folder_or_control_the_terminal(tmp_path: Path) -> None:
    evil = Parameters(force=ParametersForce((Plate("1", "\x1b[2J../x", channels=(ForceChannel("1"),)),)))
    messages = [parameters(evil), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    take = write_take(tmp_path / "take.lcmlog", messages)
    done = run_in_process("export", take, tmp_path / "walk.c3d")
    assert done.returncode == 0
    assert "\x1b" not in done.stderr
    assert names(tmp_path) == ["take.lcmlog", "walk.c3d"]
