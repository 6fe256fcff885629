"""`make test` reports a worker that crashes, whatever the worker leaves behind."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CRASH = """
import os, time

def test_that_crashes():
    if os.fork() == 0:
        time.sleep(600)
    os._exit(1)

def test_that_passes():
    pass
"""


def test_a_worker_that_crashes_while_its_child_lives_is_reported(tmp_path: Path) -> None:
    """A test that exceeds its time-out ends its worker, and the processes that it started often live on."""
    (tmp_path / "test_crash.py").write_text(CRASH)
    run = subprocess.run(
        [sys.executable, "tests/run.py", "-p", "tests.conftest", "-p", "no:cacheprovider", str(tmp_path)],
        cwd=ROOT,
        preexec_fn=lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),  # half the workers
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 1
    assert "crashed while running" in run.stdout
    assert "1 failed, 1 passed" in run.stdout
