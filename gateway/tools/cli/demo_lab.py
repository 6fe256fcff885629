"""The demo: simulator, gateway, a subscriber of each output, and the 3D view in a process of its own.

No data leaves the machine: Zenoh uses loopback TCP without scouting, LCM stays in memory (or uses
multicast with ``udpm``). The measurement starts after all subscribers have received the gateway's status,
and stops before they close, so every component that was sent must arrive. Messages that the gateway skipped
on purpose and messages that arrived late are counted apart from lost ones.
"""

import asyncio
import contextlib
import importlib.util
import socket
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeAlias

from rich.console import Console
from rich.live import Live
from rich.table import Table

from gateway.config.settings import MetricsSettings, SourceSettings
from gateway.daemon.gateway import Gateway
from gateway.errors import OutputError, ViewError
from gateway.messages.decode import decode, prefix_of
from gateway.messages.host_time import now_utime
from gateway.messages.summary import summarise
from gateway.outputs.kind import DemoSide
from gateway.outputs.registry import OUTPUTS, settings_type
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER
from gateway.runtime.workers import module_environment
from gateway.session.server.scene import Scene
from gateway.session.state import StreamState
from gateway.session.status import SKIPPED
from gateway.simulator.simulator import Simulator

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
    port = _PORT
    for candidate in (_PORT, 0):  # the usual port of the view, or another one if that is taken
        with contextlib.suppress(OSError), socket.create_server((_HOST, candidate)) as test:
            port = int(test.getsockname()[1])
            break
    command = [
        sys.executable,
        "-m",
        "gateway.tools.cli.demo_view",
        "view",
        "--connect",
        endpoint,
        "--port",
        str(port),
    ]
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


SOURCE: Final = "demo"
_START_TIMEOUT_S: Final = 10.0
_QUIET_S: Final = 3.0
"""If nothing arrives for this long after the end, what is missing then is lost."""

_REFRESH_S: Final = 0.5
_MESSAGE_WIDTH: Final = 60


@dataclass
class _Received:
    """What one subscriber received, by component. Its thread writes, the event loop reads."""

    max_lag_s: float
    """Messages that arrive later than this after their capture are late."""
    count: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    newest: dict[str, bytes] = field(default_factory=dict)
    shown: Counter[str] = field(default_factory=Counter)
    """What was counted when the live table was shown last."""

    def add(self, name: str, message: bytes) -> None:
        """Count a message. ``name`` is a key or channel, such as mocap/demo/3d or MOCAP_DEMO_3D."""
        component = name.replace("_", "/").rsplit("/", 1)[-1].lower()
        self.count[component] += 1
        self.newest[component] = message
        if component in COMPONENTS_BY_KEY:
            self.late[component] += now_utime() - prefix_of(message).capture_utime > 1e6 * self.max_lag_s

    def num_missing(self, sent: Counter[str]) -> int:
        """Return how many of the messages that were sent have not arrived."""
        return sum(max(0, count - self.count[component]) for component, count in sent.items())


async def run_demo(
    scene: Scene,
    stop: asyncio.Event,
    console: Console,
    *,
    seconds: float | None = None,
    udpm: bool = False,
    view: Callable[[str], AbstractAsyncContextManager[None]] | None = None,
) -> bool:
    """Show rates and values for ``seconds``, or until ``stop``; return whether every message was received.

    ``view`` starts a viewer that subscribes at a Zenoh endpoint, until the end of the demo. Raises
    OutputError if Zenoh or LCM does not open on this machine.
    """
    sides = {name: kind.demo(udpm) for name, kind in OUTPUTS.items() if kind.demo is not None}
    async with contextlib.AsyncExitStack() as stack:
        simulator = await stack.enter_async_context(Simulator(scene))
        simulator.stop_measurement()
        source_settings = SourceSettings(name=SOURCE, host="127.0.0.1", port=simulator.port)
        settings = settings_type().model_validate(
            {
                "sources": (source_settings,),
                "metrics": MetricsSettings(enabled=False),
                **{name: side.settings for name, side in sides.items()},
            }
        )
        received = {name: _Received(source_settings.max_lag_ms / 1000) for name in sides}
        gateway = Gateway(settings, [side.output for side in sides.values()])
        await stack.enter_async_context(_running(gateway))
        for name, side in sides.items():
            await _until(partial(_is_open, side), _START_TIMEOUT_S, f"{name} did not open")
            stack.callback(side.subscribe(SOURCE, received[name].add).close)
            if view is not None and side.endpoint is not None:
                await stack.enter_async_context(view(side.endpoint))
        await _until(
            lambda: all(each.count["status"] for each in received.values()),
            _START_TIMEOUT_S,
            "the gateway's status did not arrive on every output",
        )
        [source] = gateway.sources
        await _until(
            lambda: all(status.state is StreamState.NO_MEASUREMENT for status in source.statuses),
            _START_TIMEOUT_S,
            "the gateway did not request every component",
        )
        simulator.start_measurement()
        await _show(received, stop, seconds, console)
        simulator.stop_measurement()
        sent = simulator.components_sent
        await _wait_for_missing(sent, received)
        losses = [loss for status in source.statuses for loss in status.losses.report()]
        skipped = sum(loss.messages for loss in losses if loss.cause == SKIPPED)  # before any output
    console.print(_report(sent, received))
    lost = sum(max(0, each.num_missing(sent) - skipped) for each in received.values())
    late = sum(each.late.total() for each in received.values())
    console.print(
        f"{skipped} messages were skipped, and {late} arrived late "
        f"(more than {source_settings.max_lag_ms:g} ms after their capture)."
    )
    if simulator.frames_dropped:
        console.print(
            f"The simulator left out {simulator.frames_dropped} frames that were more than 1 s late."
        )
    console.print("[green]Nothing was lost.[/]" if not lost else f"[red]{lost} messages were lost.[/]")
    return not lost


@contextlib.asynccontextmanager
async def _running(gateway: Gateway) -> AsyncIterator[None]:
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    try:
        yield
    finally:
        stop.set()
        await task


def _is_open(side: DemoSide) -> bool:
    return side.output.health().connected


async def _until(condition: Callable[[], bool], timeout_s: float, failure: str) -> None:
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():  # noqa: ASYNC110 - other threads change the conditions
                await asyncio.sleep(0.02)
    except TimeoutError:
        raise OutputError(f"{failure} within {timeout_s:g} s", cause="demo") from None


async def _show(
    received: dict[str, _Received], stop: asyncio.Event, seconds: float | None, console: Console
) -> None:
    """Wait for ``seconds``, or until ``stop``, and show the live table if the output is a terminal."""
    end = "s; Ctrl-C ends it" if seconds is None else f"of {seconds:.0f} s"
    start_s = time.monotonic()
    elapsed_s = 0.0
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while not stop.is_set() and (seconds is None or elapsed_s < seconds):
            wait_s = _REFRESH_S if seconds is None else min(_REFRESH_S, seconds - elapsed_s)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), wait_s)
            now_s = time.monotonic() - start_s
            if console.is_terminal:
                title = f"RTC3D simulator → gateway → subscribers, {now_s:.0f} {end}"
                live.update(_table(received, now_s - elapsed_s, title), refresh=True)
            elapsed_s = now_s


async def _wait_for_missing(sent: Counter[str], received: dict[str, _Received]) -> None:
    """Wait until every message that was sent has arrived, or none arrives for _QUIET_S."""

    def num_missing() -> int:
        return sum(each.num_missing(sent) for each in received.values())

    while missing := num_missing():
        try:
            await _until(lambda: num_missing() < missing, _QUIET_S, "messages are missing")
        except OutputError:
            return


def _table(received: dict[str, _Received], elapsed_s: float, title: str) -> Table:
    """Return the live table, ``elapsed_s`` after the one before."""
    table = Table("component", title=title)
    for output in received:
        table.add_column(f"{output} Hz", justify="right")
    table.add_column("newest message", width=_MESSAGE_WIDTH, no_wrap=True, overflow="ellipsis")
    for component in WIRE_ORDER:
        key = component.key
        cells = [key]
        for each in received.values():
            count = each.count[key]
            cells.append(f"{(count - each.shown[key]) / elapsed_s:.1f}")
            each.shown[key] = count
        newest = next(iter(received.values())).newest.get(key)
        table.add_row(*cells, "" if newest is None else summarise(decode(newest)))
    return table


def _report(sent: Counter[str], received: dict[str, _Received]) -> Table:
    table = Table("component", title="Messages sent, received, late and missing")
    columns = [f"{output}\n{what}" for output in received for what in ("received", "late", "missing")]
    for heading in ("sent", *columns):
        table.add_column(heading, justify="right")
    for component in WIRE_ORDER:
        cells = []
        for each in received.values():
            count = each.count[component.key]
            cells += [str(count), str(each.late[component.key]), str(sent[component.key] - count)]
        table.add_row(component.key, str(sent[component.key]), *cells)
    return table
