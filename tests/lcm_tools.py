"""LCM's own programs lcm-logger and lcm-logplayer, as they are in the wheel."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import lcm

_FOLDER: Final = Path(lcm.__file__).parents[1] / "bin"
"""The programs in .venv/bin start these, and leave them behind when they are killed."""


def lcm_tool(name: str) -> str:
    """Return the path of one of LCM's programs."""
    return str(_FOLDER / name)


@contextlib.contextmanager
def lcm_logger(log: Path, url: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run lcm-logger until the end of the block."""
    command = [lcm_tool("lcm-logger"), f"--lcm-url={url}", "--flush-interval=1", str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.wait()
