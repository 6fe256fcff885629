"""``rtc3d-gateway simulate`` and ``demo``: a simulated server, alone or with a gateway and subscribers."""

import gc
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gateway.cli.options import LogOptions, check_exists, checked_host, source_names, with_options
from gateway.cli.run import SWITCH_INTERVAL_S
from gateway.logs.log_format import LogLevel, set_up_log
from gateway.rtc3d.packets import FIRST_PRINCIPLES_PORT

if TYPE_CHECKING:
    from gateway.cli.demo_lab import ViewProcess
    from gateway.rtc3d_server.scene import Scene
    from gateway.simulator.simulator import Scenario, Simulator


@dataclass(frozen=True)
class SceneOptions:
    """The scene of a simulated server."""

    markers: Annotated[int, typer.Option(min=0, max=10_000, help="Markers in the synthetic scene.")] = 24
    tools: Annotated[int, typer.Option(min=0, max=1_000, help="6D tools in the synthetic scene.")] = 4
    analog: Annotated[
        int, typer.Option(min=0, max=10_000, help="Analog channels in the synthetic scene.")
    ] = 16
    plates: Annotated[int, typer.Option(min=0, max=100, help="Force plates in the synthetic scene.")] = 2
    rate: Annotated[float, typer.Option(min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")] = (
        200.0
    )
    analog_rate: Annotated[
        float, typer.Option(min=0.1, max=100_000, help="Analog and force samples per second, in Hz.")
    ] = 2000.0
    c3d: Annotated[
        Path | None, typer.Option("--c3d", help="Play this C3D file instead of a synthetic scene.")
    ] = None

    def settings(self) -> dict[str, Any]:
        """Return the settings of the synthetic scene by their names."""
        return {
            "markers": self.markers,
            "tools": self.tools,
            "analog": self.analog,
            "plates": self.plates,
            "rate_hz": self.rate,
            "analog_rate_hz": self.analog_rate,
        }


def _list_faults(context: typer.Context, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from gateway.simulator.simulator import describe_kinds

        print(describe_kinds())
        raise typer.Exit


@with_options
def simulate(
    context: typer.Context,
    *,
    host: Annotated[str, typer.Option(callback=checked_host, help="The address to listen on.")] = "127.0.0.1",
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
            help="Play this recording (.lcmlog, or the folder of a saved take) as its server sent it.",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            autocompletion=source_names, help="The source of the take to play; needed if it has several."
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
    log: LogOptions,
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
    check_exists("--c3d", synthetic.c3d)
    check_exists("--take", take)
    level = log.chosen_level()
    import uvloop

    from gateway.simulator.c3d_scene import C3dScene
    from gateway.simulator.simulator import Scenario, Simulator, load_scenario, parse_fault
    from gateway.simulator.take_scene import TakeScene

    set_up_log(level, log.log_format)
    # Only options given on the command line override the scenario's scene.
    overrides = {
        name: value
        for name, value in synthetic.settings().items()
        if _is_on_command_line(context, name.removesuffix("_hz"))
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
    # A take is read by a thread, while frames are sent.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.freeze()
    uvloop.run(_run_simulator(Simulator(scene, host=host, port=port, once=once), extended, seconds))


def _is_on_command_line(context: typer.Context, option: str) -> bool:
    source = context.get_parameter_source(option)
    return source is not None and source.name == "COMMANDLINE"


async def _run_simulator(simulator: "Simulator", scenario: "Scenario", seconds: float | None) -> None:
    import asyncio

    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with simulator:
        print(f"RTC3D server on {simulator.host}:{simulator.port}; press Ctrl-C to stop", flush=True)
        simulator.faults.play(scenario.faults, seed=scenario.seed, scene=scenario.scene)
        with suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), seconds)


@with_options
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
    check_exists("--c3d", synthetic.c3d)
    import uvloop

    from gateway.cli.demo_lab import view_is_installed, view_process
    from gateway.simulator.c3d_scene import C3dScene
    from gateway.simulator.synthetic import SyntheticScene

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
    if not uvloop.run(_run_demo(scene, run_s, udpm, watch)):
        raise typer.Exit(1)


async def _run_demo(scene: "Scene", seconds: float | None, udpm: bool, view: "ViewProcess | None") -> bool:
    """Run the demo; without a time, Ctrl-C ends it."""
    import asyncio

    from rich.console import Console

    from gateway.cli.demo_lab import run_demo

    stop = asyncio.Event()
    if seconds is None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
    return await run_demo(scene, stop, Console(), seconds=seconds, udpm=udpm, view=view)
