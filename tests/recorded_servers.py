"""Takes of simulated servers, with a gateway in between."""

import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from gateway.config.settings import MetricsSettings, SourceSettings
from gateway.gateway import Gateway
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.rtc3d_server.computed_scene import ComputedScene
from gateway.rtc3d_server.scene import Scene
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.configurations import make_settings
from tests.running_gateway import running_gateway
from tests.waiting import wait_until_async


@asynccontextmanager
async def recording_gateway(port: int, path: Path, **source: object) -> AsyncIterator[Gateway]:
    """Run a gateway that records the server on ``port`` to an event log, as LCM writes it."""
    settings = make_settings(
        sources=(SourceSettings(name="lab", host="127.0.0.1", port=port, **source),),  # type: ignore[arg-type]
        metrics=MetricsSettings(enabled=False),
        lcm=LcmSettings(url=f"file://{path}?mode=w", queries=False),
    )
    async with running_gateway(Gateway(settings, [LcmOutput(settings.lcm)])) as gateway:
        yield gateway


async def record(scene: Scene, path: Path, until: Callable[[Simulator, Gateway], bool]) -> Path:
    """Serve a scene once; record what a gateway receives from its begin until the condition is met."""
    async with Simulator(scene, once=True) as simulator, recording_gateway(simulator.port, path) as gateway:
        await wait_until_async(lambda: until(simulator, gateway), 60)
    return path


def has_ended(simulator: Simulator, gateway: Gateway) -> bool:
    """Return whether the only pass of the scene has been played and received."""
    [source] = gateway.sources
    states = {status.state for status in source.statuses}
    return (
        simulator.frames_sent > 0
        and simulator.elapsed_us() is None
        and states == {StreamState.NO_MEASUREMENT}
    )


def c3d_scene(name: str) -> C3dScene:
    return C3dScene(Path(os.environ["RTC3D_TAKES"]) / name)


def lab_scene() -> ComputedScene:
    scene = SyntheticScene(markers=30, tools=5, analog=16, plates=2, rate_hz=100, analog_rate_hz=1000)
    scene.num_frames = 250
    return scene


SCENES: dict[str, Callable[[], ComputedScene]] = {
    "optotrak": lambda: c3d_scene("optotrak.c3d"),
    "qualisys": lambda: c3d_scene("qualisys.c3d"),
    "synthetic": lab_scene,
}
