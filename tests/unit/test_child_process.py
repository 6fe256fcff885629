"""Processes that run a module of this package."""

import subprocess
import sys
from pathlib import Path

from gateway.child_process import module_environment


def test_modules_in_the_working_directory_are_not_used(tmp_path: Path) -> None:
    for name in ("gateway.py", "queue.py"):
        (tmp_path / name).write_text("raise ImportError('this is a program of the user')")
    command = [sys.executable, "-m", "gateway", "--version"]
    subprocess.run(command, cwd=tmp_path, env=module_environment(), check=True)
