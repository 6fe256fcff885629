"""``rtc3d-gateway run``, ``simulate`` and ``demo``: the gateway, a simulated server, or both together."""

import logging
import os
import select
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gateway.rtc3d.packets import FIRST_PRINCIPLES_PORT
from gateway.runtime.log_format import LogLevel, set_up_log
from gateway.runtime.process_end import end_at_once
from gateway.runtime.process_start import keep_event_loop_responsive
from gateway.tools.cli import completion, options

if TYPE_CHECKING:
    import asyncio

    from gateway.session.server.scene import Scene


logger = logging.getLogger(__name__)


@options.with_options
def run(
    *, config: options.ConfigOption = None, server: options.ServerOption = None, log: options.LogOptions
) -> None:
    """Run the gateway until Ctrl-C or SIGTERM. SIGHUP reloads the configuration."""
    for number in (signal.SIGINT, signal.SIGTERM):  # until the daemon handles them
        signal.signal(number, end_at_once)
    level = log.chosen_level()
    import uvloop

    from gateway.daemon.daemon import serve
    from gateway.runtime.log_format import LogLimit
    from gateway.tools.cli.config import chosen_file, configuration_from_options

    limit = LogLimit()
    set_up_log(level, log.log_format, limit)
    keep_event_loop_responsive()
    file = chosen_file(config, server)
    if file is not None and config is None:
        logger.info("the configuration is %s, because none was given", file)
    uvloop.run(serve(lambda: configuration_from_options(file, server).settings, limit.report))
    limit.report(at_once=True)


class StopSignals:
    """Waits for Ctrl-C, SIGTERM or SIGHUP; the second one calls ``end_at_once``, which ends the process.

    A threading.Event cannot be set in a signal handler: the handler may interrupt its ``wait`` while that
    holds the lock that ``set`` needs. A pipe has no lock. Create it in the main thread.
    """

    def __init__(self, end_at_once: Callable[[int], object]) -> None:
        self._end_at_once = end_at_once
        self._is_set = False
        self._reading, self._writing = os.pipe()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, and shells for `&`
                signal.signal(number, self._handle)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the first signal; return whether it has come."""
        return bool(select.select([self._reading], [], [], timeout_s)[0])

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if self._is_set:
            self._end_at_once(number)
        self._is_set = True
        os.write(self._writing, b"\0")


@dataclass(frozen=True)
class SceneOptions:
    """The scene of a simulated server."""

    markers: Annotated[int, typer.Option(min=0, max=10_000, help="Markers in the synthetic scene.")] = 24
    tools: Annotated[int, typer.Option(min=0, max=1_000, help="6D tools in the synthetic scene.")] = 4
    analog: Annotated[
        int, typer.Option(min=0, max=10_000, help="Analog channels in the synthetic scene.")
    ] = 16
    plates: Annotated[int, typer.Option(min=0, max=100, help="Force plates in the synthetic scene.")] = 2
    rate_hz: Annotated[
        float, typer.Option("--rate", min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")
    ] = 200.0
    analog_rate_hz: Annotated[
        float,
        typer.Option(
            "--analog-rate", min=0.1, max=100_000, help="Analog and force samples per second, in Hz."
        ),
    ] = 2000.0
    c3d: Annotated[
        Path | None,
        typer.Option(
            "--c3d",
            autocompletion=completion.c3d_files,
            help="Play this C3D file instead of a synthetic scene.",
        ),
    ] = None

    def settings(self) -> dict[str, Any]:
        """Return the settings of the synthetic scene by their names."""
        return {name: value for name, value in asdict(self).items() if name != "c3d"}


def _list_faults(context: typer.Context, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from gateway.simulator.simulator import describe_kinds

        print(describe_kinds())
        raise typer.Exit


@options.with_options
def simulate(
    context: typer.Context,
    *,
    host: Annotated[
        str, typer.Option(callback=options.checked_host, help="The address to listen on.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port to listen on; 0 picks a free one.")
    ] = FIRST_PRINCIPLES_PORT,
    seconds: Annotated[
        float | None,
        typer.Option(min=0, help="Stop after this many seconds; the default is to run until Ctrl-C."),
    ] = None,
    synthetic: SceneOptions,
    take: Annotated[
        Path | None,
        typer.Option(
            autocompletion=completion.take_files,
            help="Play this recording (.lcmlog, or the folder of a saved take) as its server sent it.",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            autocompletion=completion.source_names,
            help="The source of the take to play; needed if it has several.",
        ),
    ] = None,
    from_s: Annotated[
        float | None,
        typer.Option("--from", min=0, help="Begin this many seconds after the take's beginning."),
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", min=0, help="End this many seconds after the take's beginning.")
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Play the C3D file or the take once, then send No Data.")
    ] = False,
    scenario: Annotated[
        Path | None,
        typer.Option(help="A YAML file with a scene and faults; see config/scenarios/bad-day.yaml."),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="A fault, for example 'delay,delay_ms=80,at_s=5'; can be repeated."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the random choices that faults make.")
    ] = None,
    list_faults: Annotated[  # noqa: ARG001 - the callback does the work
        bool,
        typer.Option("--list-faults", callback=_list_faults, is_eager=True, help="List all faults and exit."),
    ] = False,
    log: options.LogOptions,
) -> None:
    """Simulate an RTC3D server that plays a synthetic scene, a C3D file or a take, with faults on request."""
    if once and synthetic.c3d is None and take is None:
        raise typer.BadParameter("--once needs --c3d or --take: a synthetic scene has no end")
    if synthetic.c3d is not None and take is not None:
        raise typer.BadParameter("give either --c3d or --take")
    if take is None and not (source is None and from_s is None and to_s is None):
        raise typer.BadParameter("--source, --from and --to need --take")
    if from_s is not None and to_s is not None and to_s <= from_s:
        raise typer.BadParameter(f"--to {to_s:g} is not after --from {from_s:g}")
    options.check_exists("--c3d", synthetic.c3d)
    options.check_exists("--take", take)
    level = log.chosen_level()
    import asyncio

    import uvloop

    from gateway.simulator.c3d_scene import C3dScene
    from gateway.simulator.simulator import Scenario, Simulator, load_scenario, parse_fault
    from gateway.simulator.take_scene import TakeScene

    set_up_log(level, log.log_format)
    # Only options given on the command line override the scenario's scene.
    overrides = {
        name: value
        for name, value in synthetic.settings().items()
        if getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"
    }
    base = Scenario(faults=()) if scenario is None else load_scenario(scenario)
    extended = base.with_overrides(overrides, map(parse_fault, fault or ()), seed)
    scene: Scene
    if take is not None:
        scene = TakeScene(take, source, from_s=from_s, to_s=to_s)
    elif synthetic.c3d is not None:
        scene = C3dScene(synthetic.c3d)
    else:
        scene = extended.scene.build()
    keep_event_loop_responsive()

    async def play() -> None:
        stop = _stop_event()
        async with Simulator(scene, host=host, port=port, once=once) as simulator:
            print(f"RTC3D server on {simulator.host}:{simulator.port}; press Ctrl-C to stop", flush=True)
            simulator.faults.play(extended.faults, seed=extended.seed, scene=extended.scene)
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), seconds)

    uvloop.run(play())


def _stop_event() -> "asyncio.Event":
    """Return an event that Ctrl-C and SIGTERM set."""
    import asyncio

    stop = asyncio.Event()
    _call_at_stop(stop.set)
    return stop


def _call_at_stop(function: Callable[[], object]) -> None:
    """Call a function of the running event loop at Ctrl-C and SIGTERM."""
    import asyncio

    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, function)


@options.with_options
def demo(
    *,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, help="How many seconds to run; 10 by default, with --view until Ctrl-C."),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Open the 3D view in the browser, and run until Ctrl-C.")
    ] = False,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="With --view, only print the address of the 3D view.")
    ] = False,
    udpm: Annotated[
        bool, typer.Option("--udpm", help="Use real multicast for LCM instead of LCM in memory.")
    ] = False,
    synthetic: SceneOptions,
) -> None:
    """Run a self-contained demo: simulator, gateway and two subscribers. Counts lost messages.

    If the extra `view` is installed, the demo can be watched in a browser while it runs.
    """
    options.check_exists("--c3d", synthetic.c3d)
    import asyncio

    import uvloop
    from rich.console import Console

    from gateway.simulator.c3d_scene import C3dScene
    from gateway.simulator.synthetic import SyntheticScene
    from gateway.tools.cli.demo_lab import run_demo, view_is_installed, view_process

    set_up_log(LogLevel.WARNING)
    scene: Scene = (
        SyntheticScene(**synthetic.settings()) if synthetic.c3d is None else C3dScene(synthetic.c3d)
    )
    run_s = seconds if seconds is not None or view else 10.0
    watch = (
        partial(view_process, is_required=view, opens_browser=not no_browser)
        if view or view_is_installed()
        else None
    )

    async def play() -> bool:
        stop = _stop_event()
        running = asyncio.ensure_future(
            run_demo(scene, stop, Console(), seconds=run_s, udpm=udpm, view=watch)
        )
        if run_s is not None:  # it ends before it is complete, and has nothing to report
            _call_at_stop(running.cancel)
        return await running

    try:
        is_complete = uvloop.run(play())
    except asyncio.CancelledError:
        raise typer.Exit(130) from None
    if not is_complete:
        raise typer.Exit(1)
