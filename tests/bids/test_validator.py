"""What the official validator of BIDS says about data sets of ``rtc3d-gateway export --bids``."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.c3d_scene import C3dScene
from tests.support.commands import run_in_process
from tests.support.errors import names
from tests.support.takes import description, details, frame, markers, record_scene, write_take
from tests.unit.takes.export.exported import labelled
from tests.unit.takes.export.test_rosbag import status

WALK = Path(__file__).parents[2] / "examples/walk.lcmlog"
VALIDATOR = Path(sys.executable).with_name("bids-validator-deno")


def export(take: Path, study: Path, *options: str) -> tuple[str, str]:
    """Return what the command prints, and its notes."""
    done = run_in_process("export", take, study, "--bids", *options)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def validate(study: Path) -> dict[str, Any]:
    """Return the summary of the validator, which finds no error, and warns only of what nobody said."""
    done = subprocess.run(
        [VALIDATOR, study, "--format", "json", "--max-rows", "-1"],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
        env=os.environ | {"DENO_DIR": str(study.parent / "deno")},
    )
    found = json.loads(done.stdout)
    issues = found["issues"]["issues"]
    assert [issue for issue in issues if issue["severity"] == "error"] == []
    codes = {issue["code"] for issue in issues}
    assert codes <= {
        "EVENTS_TSV_MISSING",
        "JSON_KEY_RECOMMENDED",
        "NO_AUTHORS",
        "SIDECAR_KEY_RECOMMENDED",
        "TOO_FEW_AUTHORS",
    }
    assert done.returncode == 0
    return dict(found["summary"])


def test_the_official_validator_finds_no_error(tmp_path: Path) -> None:
    """Two subjects, one in two sessions; several sources, measurements and runs; labels of any kind."""
    messages = [description(source) for source in ("lab-a", "Studio B")]
    for source in ("lab-a", "Studio B"):
        messages += [details("Ä 7", "1/2", "left\\knee", source)]
        messages += [markers(3, number, source=source, session=number // 10) for number in range(20)]
    messages.append(status("world", (0.0, 0.0, 0.6, 0.8), 2e-3))
    messages += [labelled('a\t"b', "", "ü" * 200), frame(ComponentType.EVENT, [(7, 5_000, -1, -1, -1)], 2)]
    messages += [
        frame(ComponentType.MARKERS, [(1, 2, 3, 0)] * 3, number, source="lab") for number in range(3)
    ]
    odd = write_take(tmp_path / "odd.lcmlog", messages)
    study = tmp_path / "study"
    stdout, stderr = export(WALK, study, "--subject", "01", "--task", "walking")
    assert f"{study}/sub-01/sub-01_scans.tsv (" in stdout
    assert names(stderr, "positions", "mm to m")
    export(WALK, study, "--subject", "01", "--task", "walking", "--from", "2")
    export(odd, study, "--task", "odd")
    export(odd, study, "--task", "odd", "--session", "3", "--run", "5")
    summary = validate(study)
    assert sorted(summary["subjects"]) == ["01", "7"]
    assert sorted(summary["sessions"]) == ["12", "3"]
    assert summary["dataTypes"] == ["motion"]


@pytest.mark.takes
def test_the_validator_finds_no_error_in_real_recordings(tmp_path: Path) -> None:
    for number, (name, count) in enumerate((("qualisys", 340), ("optotrak", 29))):
        scene = C3dScene(Path(os.environ["RTC3D_TAKES"]) / f"{name}.c3d")
        take = record_scene(tmp_path / f"{name}.lcmlog", scene, count)
        export(take, tmp_path / "study", "--subject", str(number), "--task", "recorded")
    assert sorted(validate(tmp_path / "study")["subjects"]) == ["0", "1"]
