"""Logs of LCM's own logger, recorded from a gateway: read as takes, with all values and labels."""

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import ezc3d
import lcm
import numpy as np
import pytest

from gateway.config.settings import SourceSettings
from gateway.gateway import Gateway
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.rtc3d_server.scene import Scene
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes import open_take
from gateway.takes.reader import TakeReader
from gateway.takes.statistics import take_statistics
from tests.configurations import make_settings
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

LCM_URL = "udpm://239.255.76.67:7712?ttl=0&recv_buf_size=2000000"
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
        gateway = asyncio.create_task(Gateway(settings, [LcmOutput(settings.lcm)]).run(stop))
        try:
            yield
        finally:
            logger.send_signal(signal.SIGINT)
            await logger.wait()
            stop.set()
            await gateway


async def has_bytes(folder: Path, num_bytes: int) -> None:
    await wait_until_async(lambda: sum(file.stat().st_size for file in folder.iterdir()) > num_bytes)


@pytest.mark.parametrize("options", [("--increment",), ("--rotate=100",)])
async def test_the_split_files_of_lcm_logger_are_one_take(tmp_path: Path, options: tuple[str, ...]) -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=2, plates=1)
    async with logged(scene, tmp_path / "log", "--split-mb=0.1", *options):
        await has_bytes(tmp_path, 500_000)
    take = open_take(tmp_path)
    assert len(TakeReader(tmp_path).logs) >= 5
    assert take.sources["lab"].markers
    assert (np.diff(take.sources["lab"].markers.sequence) > 0).all()
    assert take.num_damaged == 0


@pytest.mark.takes
async def test_a_real_recording_has_the_values_and_labels_of_its_file(tmp_path: Path) -> None:
    path = Path(os.environ["RTC3D_TAKES"]) / "qualisys.c3d"
    async with logged(C3dScene(path), tmp_path / "log"):
        await has_bytes(tmp_path, 4_000_000)
    content = ezc3d.c3d(str(path))
    positions = content["data"]["points"][:3].transpose(2, 1, 0).astype(np.float32)
    positions[np.isnan(positions).any(axis=2)] = np.nan
    samples = content["data"]["analogs"][0].T.astype(np.float32)
    source = open_take(tmp_path / "log").sources["lab"]
    markers, analog = source.markers, source.analog
    assert markers
    assert analog
    for group, labels in (("POINT", markers.labels), ("ANALOG", analog.labels)):
        expected = content["parameters"][group]["LABELS"]["value"]
        assert labels == tuple(label.strip() for label in expected)
    point = content["parameters"]["POINT"]
    assert (markers.unit, markers.rate_hz) == (point["UNITS"]["value"][0], point["RATE"]["value"][0])
    assert markers.measured_rate_hz == pytest.approx(markers.rate_hz, rel=1e-3)
    rows = (markers.frame_number - 1) % len(positions)
    np.testing.assert_array_equal(markers.positions, positions[rows])
    assert len(set(rows.tolist())) > 0.5 * len(positions)
    np.testing.assert_array_equal(analog.values, samples[(analog.frame_number - 1) % len(samples)])
    visibility = take_statistics(tmp_path / "log").sources["lab"].components["3d"].visibility
    assert list(visibility.values()) == pytest.approx(markers.is_visible.mean(axis=0).tolist())
