"""tests/run.py reports a worker that crashes, repeats failed tests in CI, sets the uptime, knows its user."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = ("-p", "tests.conftest")
CRASH = """
import os, time

def test_that_crashes():
    if os.fork() == 0:
        time.sleep(600)
    os._exit(1)

def test_that_passes():
    pass
"""

FAIL_ONCE = """
from pathlib import Path
import pytest

@pytest.mark.parametrize("name", {names})
def test_that_fails_once(name):
    path = Path({folder!r}, name)
    was_there = path.exists()
    path.touch()
    assert was_there and name != "always"

def test_that_passes():
    pass
"""

UPTIME = """
import subprocess, sys, time

def test_of_a_machine_that_has_been_up_for_400_days():
    assert time.clock_gettime(time.CLOCK_BOOTTIME) > 34_560_000
    child = "import time; print(time.monotonic())"
    assert float(subprocess.check_output([sys.executable, "-c", child])) > 34_560_000
"""


def run_tests(
    folder: Path, content: str, *arguments: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    (folder / "test_one.py").write_text(content)
    return subprocess.run(
        [sys.executable, "tests/run.py", "--workers", "1", *arguments, *PLUGINS, str(folder)],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_worker_that_crashes_while_its_child_lives_is_reported(tmp_path: Path) -> None:
    """A test that exceeds its time-out ends its worker, and the processes that it started often live on."""
    run = run_tests(tmp_path, CRASH)
    assert run.returncode == 1
    assert "crashed while running" in run.stdout
    assert "1 failed, 1 passed" in run.stdout


@pytest.mark.parametrize(
    ("names", "has_passed"),
    [(("a",), True), (("a", "always"), False), (tuple("abcdef"), False)],
)
def test_a_few_tests_that_fail_once_are_run_again_and_named(
    tmp_path: Path, names: tuple[str, ...], has_passed: bool
) -> None:
    """In CI, other work may delay a test; but a test that fails again, or many that fail, fail the run."""
    content = FAIL_ONCE.format(names=names, folder=str(tmp_path))
    run = run_tests(tmp_path, content, "--again")
    assert (run.returncode == 0) is has_passed, run.stdout
    _, _, named = run.stdout.partition("FAILED ONCE")
    assert ("test_that_fails_once[a]" in named) is has_passed
    assert "test_that_passes" not in named


@pytest.mark.netns
def test_the_tests_and_their_processes_have_the_uptime_asked_for(tmp_path: Path) -> None:
    """Otherwise `make test` would say nothing about a machine that has just booted."""
    run = run_tests(tmp_path, UPTIME, RTC3D_UPTIME_S="34560001")
    assert run.returncode == 0, run.stdout


def test_a_user_who_seems_to_be_root_in_the_namespace_of_the_tests_is_not() -> None:
    """Tests that boot a machine of their own would fail for that user, and seem to have found something."""
    script = "import os; from tests.support.needs import is_root; print(os.geteuid(), is_root())"
    command = ["unshare", "--user", "--map-root-user", sys.executable, "-c", script]
    assert subprocess.check_output(command, cwd=ROOT, text=True) == "0 False\n"
