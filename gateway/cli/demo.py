"""``rtc3d-gateway demo``: simulator, gateway and subscribers in one process."""

import signal
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from gateway.cli.options import SceneOptions, check_exists, with_options
from gateway.logs.log_format import LogLevel, set_up_log

if TYPE_CHECKING:
    from gateway.cli.demo_lab import ViewProcess
    from gateway.rtc3d_server.scene import Scene


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
    if not uvloop.run(_run(scene, run_s, udpm, watch)):
        raise typer.Exit(1)


async def _run(scene: "Scene", seconds: float | None, udpm: bool, view: "ViewProcess | None") -> bool:
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
