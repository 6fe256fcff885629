"""What make says while it installs into .venv; a script in place of pip installs nothing."""

import subprocess
from pathlib import Path

import pytest

from tests.support.fresh_clones import ROOT


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    for name in ("Makefile", "pyproject.toml", "requirements.txt", "requirements-view.txt"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    return tmp_path


def make(clone: Path, target: str, pip: str) -> subprocess.CompletedProcess[str]:
    """Run make with a Python whose venv has this script as its pip."""
    python = clone / "python"
    python.write_text(
        "#!/bin/sh\nmkdir -p .venv/bin .venv/lib/python3.11/site-packages\n"
        f"printf '#!/bin/sh\\n{pip}\\n' >.venv/bin/pip\n"
        "printf '#!/bin/sh\\n' >.venv/bin/python\nchmod +x .venv/bin/*"
    )
    python.chmod(0o755)
    command = ["make", "-C", str(clone), "--no-print-directory", target, "PYTHON=./python"]
    return subprocess.run(command, text=True, capture_output=True, check=False)


def test_each_long_step_says_what_it_does_and_how_long(clone: Path) -> None:
    made = make(clone, ".venv/installed", pip="exit 0")
    assert made.returncode == 0, made.stderr
    lines = made.stdout.splitlines()
    assert lines[0] == "Installing the gateway into .venv (about 40 s) …"
    assert lines[2] == "Installing the development tools into .venv (about 1 min) …"
    assert all(line.startswith("Done in ") and line.endswith(" s.") for line in lines[1::2])
    assert len(lines) == 4
    again = make(clone, ".venv/installed", pip="exit 1")
    assert (again.returncode, "Done in" in again.stdout) == (0, False)


def test_a_step_that_fails_is_not_done_and_is_repeated(clone: Path) -> None:
    failed = make(clone, ".venv/runtime", pip="echo no network >&2; exit 1")
    assert failed.returncode != 0
    assert "no network" in failed.stderr
    assert "Done" not in failed.stdout
    assert "Done" in make(clone, ".venv/runtime", pip="exit 0").stdout
