"""``rtc3d-gateway demo``: simulator, gateway and a subscriber on each side, in one process.

Nothing leaves the machine: Zenoh on loopback TCP without scouting, LCM in memory (or multicast with
``udpm``). The measurement starts when both subscribers hear the gateway and stops before they do, so
every component sent can be accounted for.
"""

import asyncio
import contextlib
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.table import Table

from gateway.cli.subscribers import LcmListener, ZenohListener, channel_pattern, key_pattern, open_zenoh
from gateway.config.settings import (
    LcmSettings,
    MetricsSettings,
    Settings,
    SourceSettings,
    StreamSettings,
    ZenohSettings,
)
from gateway.errors import OutputError
from gateway.gateway import Gateway
from gateway.messages.decode import decode, one_line
from gateway.outputs.lcm.output import LcmOutput, open_lcm
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d_server.scene import Scene
from gateway.simulator.simulator import Simulator

SOURCE: Final = "demo"
_SIDES: Final = ("zenoh", "lcm")
_READY_S: Final = 10.0
_DRAIN_S: Final = 3.0
_REFRESH_S: Final = 0.5
_SHOWN: Final = 60


@dataclass
class _Heard:
    """What one subscriber received, by component; filled in its thread, read in the loop."""

    received: Counter[str] = field(default_factory=Counter)
    newest: dict[str, bytes] = field(default_factory=dict)

    def take(self, name: str, message: bytes) -> None:
        """Count a message; ``name`` is mocap/demo/3d or MOCAP_DEMO_3D."""
        component = name.replace("_", "/").rsplit("/", 1)[-1].lower()
        self.received[component] += 1
        self.newest[component] = message


async def run_demo(scene: Scene, seconds: float, console: Console, *, udpm: bool) -> bool:
    """Run for ``seconds`` showing rates and values; return whether everything sent was received.

    Raises OutputError if Zenoh or LCM do not open on this machine.
    """
    heard = {side: _Heard() for side in _SIDES}
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    lcm_settings = LcmSettings(url=None if udpm else "memq://")
    subscriber_lcm = open_lcm(lcm_settings.effective_url)
    async with contextlib.AsyncExitStack() as stack:
        simulator = await stack.enter_async_context(Simulator(scene))
        simulator.stop_measurement()
        settings = _settings(simulator.port, endpoint, lcm_settings)
        zenoh_output = ZenohOutput(settings.zenoh)
        # memq:// reaches nobody but the same object, so gateway and subscriber share it.
        lcm_output = LcmOutput(lcm_settings, None if udpm else subscriber_lcm)
        await stack.enter_async_context(_running(Gateway(settings, [zenoh_output, lcm_output])))
        listener = LcmListener(subscriber_lcm, channel_pattern("MOCAP", SOURCE, None), heard["lcm"].take)
        stack.callback(listener.close)
        await _until(lambda: zenoh_output.session is not None, _READY_S, "Zenoh did not open")
        session = open_zenoh(endpoint)
        stack.callback(session.close)
        ZenohListener(session, key_pattern("mocap", SOURCE, None), heard["zenoh"].take)
        await _until(
            lambda: all(each.received["status"] for each in heard.values()),
            _READY_S,
            "the gateway's status did not come on both sides",
        )
        simulator.start_measurement()
        await _show(heard, seconds, console)
        simulator.stop_measurement()
        lost = await _settle(simulator, heard)
    console.print(_report(simulator.sent, heard))
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


def _settings(port: int, endpoint: str, lcm_settings: LcmSettings) -> Settings:
    slow = tuple(component for component in WIRE_ORDER if component is not ComponentType.ANALOG)
    return Settings(
        sources=(
            SourceSettings(
                name=SOURCE,
                host="127.0.0.1",
                port=port,
                # Analog runs at its own, higher rate on a stream of its own (§5.3.5).
                streams=(StreamSettings(components=slow), StreamSettings(components=(ComponentType.ANALOG,))),
            ),
        ),
        zenoh=ZenohSettings(
            config={
                "listen": {"endpoints": [endpoint]},
                "scouting": {"multicast": {"enabled": False}},
            }
        ),
        lcm=lcm_settings,
        metrics=MetricsSettings(enabled=False),
    )


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


async def _until(condition: Callable[[], bool], timeout_s: float, failure: str) -> None:
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():  # noqa: ASYNC110 - the conditions change in other threads
                await asyncio.sleep(0.02)
    except TimeoutError:
        raise OutputError(f"{failure} within {timeout_s:g} s", cause="demo") from None


async def _show(heard: dict[str, _Heard], seconds: float, console: Console) -> None:
    """Show the table live for ``seconds``; not where the output is no terminal."""
    start_s = time.monotonic()
    before: dict[str, Counter[str]] = {side: Counter() for side in _SIDES}
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while (elapsed_s := time.monotonic() - start_s) < seconds:
            await asyncio.sleep(min(_REFRESH_S, seconds - elapsed_s))
            now_s = time.monotonic() - start_s
            rates = {
                side: {
                    key: (each.received[key] - before[side][key]) / (now_s - elapsed_s)
                    for key in each.received
                }
                for side, each in heard.items()
            }
            before = {side: Counter(each.received) for side, each in heard.items()}
            if console.is_terminal:
                live.update(_table(heard, rates, now_s, seconds), refresh=True)


async def _settle(simulator: Simulator, heard: dict[str, _Heard]) -> int:
    """Wait until what is under way has arrived; return how many messages are missing."""

    def missing() -> int:
        return sum(
            max(0, sent - each.received[key])
            for key, sent in simulator.sent.items()
            for each in heard.values()
        )

    with contextlib.suppress(OutputError):
        await _until(lambda: not missing(), _DRAIN_S, "messages are missing")
    return missing()


def _table(
    heard: dict[str, _Heard], rates: dict[str, dict[str, float]], now_s: float, seconds: float
) -> Table:
    table = Table(title=f"RTC3D simulator → gateway → subscribers, {now_s:.0f} of {seconds:.0f} s")
    table.add_column("component")
    for side in _SIDES:
        table.add_column(f"{side} Hz", justify="right")
    table.add_column("newest message", width=_SHOWN, no_wrap=True, overflow="ellipsis")
    for component in WIRE_ORDER:
        newest = heard["zenoh"].newest.get(component.key)
        text = "" if newest is None else one_line(decode(newest))
        table.add_row(
            component.key,
            *(f"{rates[side].get(component.key, 0.0):.1f}" for side in _SIDES),
            text,
        )
    return table


def _report(sent: Counter[str], heard: dict[str, _Heard]) -> Table:
    table = Table(title="What was sent, received and lost")
    for heading in (
        "component",
        "sent",
        *(f"{side} {what}" for side in _SIDES for what in ("received", "lost")),
    ):
        table.add_column(heading, justify="left" if heading == "component" else "right")
    for component in WIRE_ORDER:
        cells = []
        for side in _SIDES:
            received = heard[side].received[component.key]
            cells += [str(received), str(sent[component.key] - received)]
        table.add_row(component.key, str(sent[component.key]), *cells)
    return table
