"""The way to MCAP: from a server through a gateway into a take, and from there into a file for viewers."""

from pathlib import Path

import pytest

from gateway.export.formats import export_take
from gateway.export.job import ExportJob
from gateway.rtc3d.components import ComponentType
from tests.recorded_servers import SCENES, has_ended, record
from tests.unit.export.read_mcap import assert_equals_take, read_mcap


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("optotrak", marks=pytest.mark.takes),
        pytest.param("qualisys", marks=pytest.mark.takes),
        "synthetic",
    ],
)
async def test_what_a_server_sent_is_in_the_file(name: str, tmp_path: Path) -> None:
    scene = SCENES[name]()
    take = await record(scene, tmp_path / "take.lcmlog", has_ended)
    job = ExportJob(take, tmp_path / "take.mcap")
    export_take(job)
    assert job.notes == []
    content = read_mcap(tmp_path / "take.mcap")
    assert_equals_take(content, take)
    assert scene.length_us is not None
    for component, topic in (
        (ComponentType.MARKERS, "markers"),
        (ComponentType.TOOLS, "tools"),
        (ComponentType.ANALOG, "analog"),
        (ComponentType.FORCE, "loads"),
    ):
        expected = round(scene.length_us * scene.rates_hz.get(component, 0) / 1e6)
        assert len(content.topics.get(f"/lab/{topic}", [])) == expected
    assert bool(content.topics.get("/lab/events")) == (name == "synthetic")
