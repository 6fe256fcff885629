"""The program under unusual conditions: no traceback, whatever the streams, locale and terminal."""

import asyncio
import contextlib
import errno
import os
import shlex
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from gateway.tools.cli.main import COMMANDS
from tests.support.errors import names
from tests.support.gateway_process import PROGRAM

ROOT: Final = Path(__file__).parents[3]
CONFIG: Final = str(ROOT / "config/gateway.yaml")
_ASCII: Final = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
_NARROW: Final = {"TERM": "dumb", "COLUMNS": "20"}


_HELP: Final = """
import os, sys
from importlib import import_module
from gateway.tools.cli.main import COMMANDS, main
for path in COMMANDS.values():
    import_module(path.partition(":")[0])
for command in (*COMMANDS, "config show"):
    if (pid := os.fork()) == 0:
        sys.argv = ["rtc3d-gateway", *command.split(), "--help"]
        main()
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    print(f"[{command}] {status}", flush=True)
"""
"""The help of each command, in forks of a process that has imported all of them."""


class Ended(NamedTuple):
    status: int
    stdout: str
    stderr: str


async def end_of(process: asyncio.subprocess.Process) -> Ended:
    """Wait for the end of a process, which must not write a traceback."""
    try:
        stdout, stderr = await asyncio.wait_for(process.communicate(), 60)
    except TimeoutError:
        process.kill()  # or the event loop of the test would wait for it, without end
        raise
    ended = Ended(process.returncode or 0, (stdout or b"").decode(), (stderr or b"").decode())
    for word in ("Traceback", "Exception ignored", "Error:", "defect", "panicked"):
        assert word not in ended.stdout + ended.stderr
    return ended


async def run(*arguments: str, environ: dict[str, str] | None = None, **options: Any) -> Ended:
    process = await asyncio.create_subprocess_exec(
        *map(os.fsencode, (*PROGRAM, *arguments)),
        env={**os.environ, **(environ or {})},
        **{"stdin": DEVNULL, "stdout": PIPE, "stderr": PIPE, **options},
    )
    return await end_of(process)


async def run_shell(script: str) -> Ended:
    """Run a shell script, in which PROGRAM is the program."""
    command = ("bash", "-c", script.replace("PROGRAM", shlex.join(PROGRAM)))
    process = await asyncio.create_subprocess_exec(*command, stdin=DEVNULL, stdout=PIPE, stderr=PIPE)
    return await end_of(process)


async def test_help_fits_every_locale_and_terminal() -> None:
    environ = {**os.environ, **_ASCII, **_NARROW}
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", _HELP, env=environ, stdout=PIPE)
    lines = (await end_of(process)).stdout.splitlines()
    assert [line for line in lines if line.startswith("[")] == [
        f"[{command}] 0" for command in (*COMMANDS, "config show")
    ]


@pytest.mark.parametrize("command", ["echo", "check"])
async def test_text_that_is_not_utf8_is_a_mistake(command: str) -> None:
    assert (await run(*command.split(), "--nope\udcff\x1b[31m", environ=_ASCII)).status == 2


@pytest.mark.parametrize("arguments", ["config schema", f"check {shlex.quote(CONFIG)}"])
async def test_output_goes_nowhere(arguments: str) -> None:
    """A reader that leaves, a full device, and a closed stream."""
    command = f"PROGRAM {arguments}"
    full = await run_shell(f"{command} >/dev/full")
    assert (full.status, full.stdout) == (1, "")
    assert names(full.stderr, os.strerror(errno.ENOSPC))
    assert (await run_shell(f"{command} 2>/dev/full")).status == 0
    for nowhere in ("| true", ">&-", ">&- 2>&- <&-"):
        ended = await run_shell(f"set -o pipefail; {command} {nowhere}")
        assert (ended.status, ended.stderr) == (0, "")


async def press_ctrl_c(process: asyncio.subprocess.Process) -> None:
    """Press it as a user does: again if nothing happens.

    A library that is just being loaded can clear the first KeyboardInterrupt, as it does with errors.
    """
    while process.returncode is None:
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), 10)


@pytest.mark.parametrize(("library", "delay_s"), [("pydantic_core", 0), ("zenoh", 0), ("zenoh", 1.5)])
async def test_ctrl_c_is_quiet_at_any_moment(library: str, delay_s: float) -> None:
    """During the imports and at the start, when a library is loaded, and while waiting."""
    commands = (("echo", "--source", "nobody"), ("doctor", "--server", "127.0.0.1:1"))

    async def interrupted(*arguments: str) -> Ended:
        process = await asyncio.create_subprocess_exec(*PROGRAM, *arguments, stdout=PIPE, stderr=PIPE)
        while library not in Path(f"/proc/{process.pid}/maps").read_text():  # noqa: ASYNC110, ASYNC240
            await asyncio.sleep(0.002)
        await asyncio.sleep(delay_s)
        pressing = asyncio.create_task(press_ctrl_c(process))
        ended = await end_of(process)
        await pressing
        return ended

    for ended in await asyncio.gather(*(interrupted(*arguments) for arguments in commands)):
        assert ended.status in {130, 0, 1}  # 0 if echo is printing, 1 if the command ended before
        assert "KeyboardInterrupt" not in ended.stderr
