"""The 3D view of the demo, in a process of its own."""

import asyncio
import contextlib
import importlib.util
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Final, TypeAlias

from gateway.child_process import module_environment
from gateway.errors import ViewError

ViewProcess: TypeAlias = Callable[[str], AbstractAsyncContextManager[None]]
"""Runs the view on a Zenoh endpoint, while the context is open."""

_HOST: Final = "127.0.0.1"
_PORT: Final = 8080
_READY_S: Final = 15.0
_STOP_S: Final = 5.0


def view_is_installed() -> bool:
    """Whether the extra ``view`` is installed."""
    return importlib.util.find_spec("viser") is not None


@asynccontextmanager
async def view_process(endpoint: str, *, is_required: bool, opens_browser: bool) -> AsyncIterator[None]:
    """Run ``rtc3d-gateway view`` on a Zenoh endpoint, and print its address when it serves the page.

    If it ``is_required``, raise ViewError if it does not start, and open a browser if ``opens_browser``.
    """
    port = _free_port()
    command = [sys.executable, "-m", "gateway", "view", "--connect", endpoint, "--port", str(port)]
    if not (is_required and opens_browser):
        command.append("--no-browser")
    # A session of its own: Ctrl-C in the terminal must not end it before the demo does.
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, start_new_session=True, env=module_environment()
    )
    assert process.stdout is not None  # noqa: S101 - it is a pipe
    try:
        line = b""
        with contextlib.suppress(TimeoutError):
            line = await asyncio.wait_for(process.stdout.readline(), _READY_S)
        if line:
            print(f"Watch it in a browser: http://{_HOST}:{port}", flush=True)
        elif is_required:
            raise ViewError("the 3D view did not start; see above, or try rtc3d-gateway view")
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), _STOP_S)
        except TimeoutError:
            process.kill()


def _free_port() -> int:
    """Return the usual port of the view, or another one if that is taken."""
    for port in (_PORT, 0):
        with contextlib.suppress(OSError), socket.create_server((_HOST, port)) as test:
            return int(test.getsockname()[1])
    return _PORT
