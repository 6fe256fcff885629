"""Logs of LCM's own logger, recorded from a gateway, are takes."""

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import lcm
import numpy as np
import pytest

from gateway.config.settings import SourceSettings
from gateway.daemon.gateway import Gateway
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.session.server.scene import Scene
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes import open_take
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.statistics import take_statistics
from tests.support.configurations import make_settings
from tests.support.waiting import num_bytes_below, wait_until_async

pytestmark = pytest.mark.netns

LCM_PORT = 7712
LCM_URL = f"udpm://239.255.76.67:{LCM_PORT}?ttl=0&recv_buf_size=2000000"
LOGGER = Path(lcm.__file__).parents[1] / "bin/lcm-logger"


@asynccontextmanager
async def logged(scene: Scene, log: Path, *options: str) -> AsyncIterator[None]:
    """Run simulator, gateway and lcm-logger; the log is complete when the context ends."""
    async with Simulator(scene) as simulator:
        settings = make_settings(
            sources=(SourceSettings(name="lab", host="127.0.0.1", port=simulator.port),),
            lcm=LcmSettings(url=LCM_URL),
        )
        stop = asyncio.Event()
        # With --increment, it ignores the name and writes to the current folder.
        logger = await asyncio.create_subprocess_exec(
            LOGGER, "-q", "-l", LCM_URL, *options, log, cwd=log.parent
        )
        # The first parameters come once: the logger must receive by then.
        await wait_until_async(lambda: f":{LCM_PORT:04X} " in Path("/proc/net/udp").read_text())
        gateway = asyncio.create_task(Gateway(settings, [LcmOutput(settings.lcm)]).run(stop))
        try:
            yield
        finally:
            logger.send_signal(signal.SIGINT)
            await logger.wait()
            stop.set()
            await gateway


@pytest.mark.parametrize("options", [("--increment",), ("--rotate=100",)])
async def test_the_split_files_of_lcm_logger_are_one_take(tmp_path: Path, options: tuple[str, ...]) -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=2, plates=1)
    async with logged(scene, tmp_path / "log", "--split-mb=0.1", *options):
        await wait_until_async(lambda: num_bytes_below(tmp_path) > 500_000)
    take, statistics = open_take(tmp_path), take_statistics(tmp_path)
    assert len(TakeReader(tmp_path).logs) >= 5
    markers, tools = take.sources["lab"].markers, take.sources["lab"].tools
    assert markers
    assert tools
    assert (np.diff(markers.sequence) > 0).all()
    assert (markers.labels, tools.labels) == (("Marker 1", "Marker 2", "Marker 3"), ("Tool 1",))
    assert markers.rate_hz == 100.0
    assert statistics.sources["lab"].components["3d"].rate_hz == pytest.approx(100, rel=1e-3)
    assert take.num_damaged == statistics.num_damaged == 0
