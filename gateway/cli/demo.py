"""``rtc3d-gateway demo``: simulator, gateway and subscribers in one process."""

from typing import Annotated

import typer

from gateway.cli.options import (
    AnalogOption,
    AnalogRateOption,
    C3dOption,
    MarkersOption,
    PlatesOption,
    RateOption,
    ToolsOption,
)
from gateway.service.log_format import LogLevel, set_up_log


def demo(
    seconds: Annotated[float, typer.Option(min=0.1, help="How many seconds to run.")] = 10.0,
    udpm: Annotated[
        bool, typer.Option("--udpm", help="Use real multicast for LCM instead of LCM in memory.")
    ] = False,
    markers: MarkersOption = 24,
    tools: ToolsOption = 4,
    analog: AnalogOption = 16,
    plates: PlatesOption = 2,
    rate: RateOption = 200.0,
    analog_rate: AnalogRateOption = 2000.0,
    c3d: C3dOption = None,
) -> None:
    """Run a self-contained demo: simulator, gateway and two subscribers. Counts lost messages."""
    import uvloop
    from rich.console import Console

    from gateway.demo import run_demo
    from gateway.rtc3d_server.scene import Scene
    from gateway.simulator.c3d_scene import C3dScene
    from gateway.simulator.synthetic import SyntheticScene

    set_up_log(LogLevel.WARNING)
    scene: Scene
    if c3d is not None:
        scene = C3dScene(c3d)
    else:
        scene = SyntheticScene(
            markers=markers,
            tools=tools,
            analog=analog,
            plates=plates,
            rate_hz=rate,
            analog_rate_hz=analog_rate,
        )
    if not uvloop.run(run_demo(scene, seconds, Console(), udpm=udpm)):
        raise typer.Exit(1)
