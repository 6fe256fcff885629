"""The sample files in examples/: what is in them, what the commands do with them, and how they are made."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from gateway.messages.decode import decode
from gateway.rtc3d.components import WIRE_ORDER
from gateway.takes import open_take
from gateway.takes.files.reader import TakeReader
from tests.support.commands import run_in_process
from tests.support.documents import ROOT
from tests.unit.takes.export.exported import read_ezc3d

TAKE: Final = ROOT / "examples/walk.lcmlog"
C3D: Final = ROOT / "examples/walk.c3d"


def test_they_are_small_and_the_take_has_all_components_gaps_in_view_and_plates_with_corners() -> None:
    assert max(TAKE.stat().st_size, C3D.stat().st_size) < 700_000
    described = (each.message for each in TakeReader(TAKE).messages() if each.key in {"take", "status"})
    assert {decode(message).host for message in described} == {"example"}
    source = open_take(TAKE).sources["lab"]
    assert source.markers is not None
    assert source.forces is not None
    components = (source.markers, source.tools, source.analog, source.forces, source.events)
    assert all(component is not None and len(component) for component in components)
    visible = source.markers.is_visible.mean(axis=0)
    assert 0.8 < visible.min() < 0.95
    assert visible.max() == 1
    [entry] = source.parameters
    assert entry.parameters.force is not None
    assert [len(plate.corners) for plate in entry.parameters.force.plates] == [4, 4]


def test_the_forces_are_below_the_feet() -> None:
    """The centre of pressure on each plate is between the heel and the toe that are on it."""
    source = open_take(TAKE).sources["lab"]
    markers, forces = source.markers, source.forces
    assert markers is not None
    assert forces is not None
    labels = list(markers.labels)
    for plate, side in enumerate("RL"):
        loaded = forces.items["fz"][:, plate] > 400
        assert 50 < loaded.sum() < 200
        fz, mx, my = (forces.items[name][loaded, plate] for name in ("fz", "mx", "my"))
        x_mm, y_mm = 200 - 1000 * my / fz, 300 + 610 * plate + 1000 * mx / fz
        frame = np.searchsorted(markers.timestamp_us, forces.timestamp_us[loaded]).clip(max=len(markers) - 1)
        heel, toe = (markers.positions[frame, labels.index(side + name)] for name in ("HEE", "TOE"))
        on_ground = ~np.isnan(heel[:, 0] + toe[:, 0])
        assert on_ground.any()
        assert (np.abs(x_mm - heel[:, 0])[on_ground] < 60).all()
        assert (y_mm > heel[:, 1] - 60)[on_ground].all()
        assert (y_mm < toe[:, 1] + 60)[on_ground].all()


def test_making_them_again_gives_the_same_content(tmp_path: Path) -> None:
    """On a busy computer, the simulator leaves frames out, or the recording begins after the first ones."""
    command = [sys.executable, str(ROOT / "examples/make_samples.py"), str(tmp_path)]
    subprocess.run(command, check=True)

    def content(take: Path) -> tuple[Any, set[tuple[str, int, bytes]]]:
        source = open_take(take).sources["lab"]
        [entry] = source.parameters
        components = (source.markers, source.tools, source.analog, source.forces, source.events)
        rows = {
            (component.key, number, items.tobytes())
            for component in components
            if component is not None
            for number, items in zip(component.frame_number.tolist(), component.items, strict=True)
        }
        return replace(entry.parameters, general=None), rows  # general has the port

    parameters, rows = content(tmp_path / "walk.lcmlog")
    committed_parameters, committed_rows = content(TAKE)
    assert parameters == committed_parameters
    assert {key for key, _, _ in rows} == {"3d", "6d", "analog", "force", "event"}
    assert not rows - committed_rows
    assert read_ezc3d(tmp_path / "walk.c3d")["data"]["points"].size


def test_the_c3d_file_is_that_of_the_take(tmp_path: Path) -> None:
    assert run_in_process("export", TAKE, tmp_path / "walk.c3d").returncode == 0
    again, committed = read_ezc3d(tmp_path / "walk.c3d")["data"], read_ezc3d(C3D)["data"]
    assert np.array_equal(again["points"], committed["points"], equal_nan=True)
    assert np.array_equal(again["analogs"], committed["analogs"], equal_nan=True)


def test_take_info_describes_the_take() -> None:
    text = run_in_process("take", "info", TAKE).stdout
    for component in WIRE_ORDER:
        assert re.search(rf"^ *{component.key} +\d+", text, re.MULTILINE)
    assert "Foot strike (0x101)  9" in text


@pytest.mark.parametrize("option", ["--take", "--c3d"])
def test_the_simulator_serves_both(option: str) -> None:
    file = TAKE if option == "--take" else C3D
    command = [
        sys.executable,
        "-m",
        "gateway",
        "simulate",
        option,
        str(file),
        "--port",
        "0",
        "--seconds",
        "0.5",
    ]
    text = subprocess.check_output(command, text=True, cwd=ROOT)
    assert "127.0.0.1:" in text


def test_the_take_is_exported(tmp_path: Path) -> None:
    """The manual exports this file to each format."""
    for extension in ("c3d", "trc", "mot", "sto", "csv", "mcap"):
        ended = run_in_process("export", TAKE, tmp_path / f"walk.{extension}")
        assert ended.returncode == 0, ended.stderr
        assert [*tmp_path.glob(f"walk*.{extension}")]
