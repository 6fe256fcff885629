"""The command line of ``rtc3d-gateway``: in processes of their own, and in this process.

``run`` and ``run_command`` need no start of Python: the processes are forked from one that has imported every
command, which saves half a second of CPU each. Like programs they have their own signals, streams and exit
status. ``run_in_process`` is for commands that end before they open or start anything. Tests of the start
itself, of terminals and of encodings start ``PROGRAM`` of tests/support/gateway_process.py instead.
"""

import asyncio
import contextlib
import io
import multiprocessing
import os
import pkgutil
import sys
import tempfile
import threading
from collections.abc import Mapping
from multiprocessing.connection import wait
from pathlib import Path
from typing import Final, NamedTuple
from unittest.mock import patch

import gateway.tools.cli
from gateway.tools.cli import main

_TIMEOUT_S: Final = 120.0
_LOCK: Final = threading.Lock()
"""Starting a process also reads the status of those that have ended. A status can be read once only."""

_FORKS: Final = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(
    [
        *(f"gateway.tools.cli.{module.name}" for module in pkgutil.iter_modules(gateway.tools.cli.__path__)),
        *(
            "gateway.tools.doctor.all_checks",
            "gateway.tools.display.top.app",
            "zenoh",
            "tests.support.commands",
        ),
    ]
)


class Completed(NamedTuple):
    status: int
    stdout: str
    stderr: str


def run_command(*arguments: str | Path, environ: Mapping[str, str] | None = None) -> Completed:
    """Run rtc3d-gateway to its end, with a width of 200 columns unless ``environ`` has another one."""
    variables = {**os.environ, "COLUMNS": "200", **(environ or {})}
    with tempfile.TemporaryDirectory() as folder:
        process = _FORKS.Process(target=_run, args=(list(map(str, arguments)), folder, variables))
        with _LOCK:
            process.start()
        wait([process.sentinel], _TIMEOUT_S)
        with _LOCK:
            if process.exitcode is None:
                process.kill()
            process.join()
        assert process.exitcode is not None
        texts = [(Path(folder) / name).read_text() for name in ("stdout", "stderr")]
        return Completed(process.exitcode, *texts)


async def run(*arguments: str | Path, environ: Mapping[str, str] | None = None) -> Completed:
    """Run rtc3d-gateway to its end, without blocking the event loop."""
    return await asyncio.to_thread(run_command, *arguments, environ=environ)


def _run(arguments: list[str], folder: str, environ: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(environ)
    for number, name in ((1, "stdout"), (2, "stderr")):
        descriptor = os.open(Path(folder) / name, os.O_CREAT | os.O_WRONLY)
        os.dup2(descriptor, number)
        os.close(descriptor)
        setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115 - until the end
    sys.argv = ["rtc3d-gateway", *arguments]
    from gateway.__main__ import main  # noqa: PLC0415 - it must not handle signals of this process

    main()


class Ended(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run_in_process(*arguments: str | Path) -> Ended:
    """Run ``rtc3d-gateway`` with these arguments; it prints errors as the program does."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["rtc3d-gateway", *map(str, arguments)]),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        status = main._run()
    return Ended(status, stdout.getvalue(), stderr.getvalue())
