"""Viewers of a real gateway: what they get is what the server sent, and what a take exports."""

import asyncio
from collections import defaultdict
from pathlib import Path

from mcap.reader import make_reader

from gateway.daemon.gateway import Gateway
from gateway.outputs.adapters.foxglove.output import FoxgloveOutput
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import ExportJob, export_take
from tests.support.configurations import local_settings, local_source
from tests.support.foxglove_viewer import viewing
from tests.support.gateways import running_gateway
from tests.support.networks import free_port

SCENE = SyntheticScene(markers=20, tools=3, analog=12, plates=2, rate_hz=100, analog_rate_hz=500)
FRAMES = ("markers", "tools", "analog", "loads", "forces", "events")
TOPICS = tuple(f"/lab/{name}" for name in (*FRAMES, "plates", "parameters"))


def raw_messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return the time and the bytes of each message of an MCAP file, by topic."""
    found: defaultdict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found[channel.topic].append((message.log_time, message.data))
    return found


async def test_viewers_get_the_same_bytes_that_a_take_exports(tmp_path: Path) -> None:
    takes = TakesOutput(TakesSettings(enabled=True, directory=str(tmp_path / "takes")))
    viewers = FoxgloveOutput(FoxgloveSettings(enabled=True, port=free_port()))
    async with Simulator(SCENE) as server:
        gateway = Gateway(local_settings(local_source(server.port)), [takes, viewers])
        async with running_gateway(gateway):
            await gateway.opened.wait()
            async with viewing(viewers.settings.port, *TOPICS) as viewer:
                for name in FRAMES:
                    await viewer.wait_for(f"/lab/{name}")
                await takes.takes("lab").start("take")
                for name in ("markers", "analog"):
                    await viewer.wait_for(f"/lab/{name}", len(viewer.received[f"/lab/{name}"]) + 100)
                await viewer.wait_for("/lab/events", len(viewer.received["/lab/events"]) + 1)
                await takes.takes("lab").stop()
                await viewer.wait_for("/lab/analog", len(viewer.received["/lab/analog"]) + 100)
                schemas = viewer.topics
                description = viewer.received["/lab/parameters"][0].content
                [take] = (tmp_path / "takes").glob("*/*.lcmlog")
                job = ExportJob(take, tmp_path / "take.mcap")
                await asyncio.to_thread(export_take, job)
                changed = [note for note in job.notes if not note.what.startswith("labels of ")]
                assert [note for note in changed if note.amount] == []
                exported = raw_messages(tmp_path / "take.mcap")
                last_ns = {topic: exported[topic][-1][0] for topic in (f"/lab/{name}" for name in FRAMES)}
                await viewer.wait_until(
                    lambda: all(viewer.received[topic][-1].time_ns >= last_ns[topic] for topic in last_ns)
                )
                losses = {output.name: status.losses for output, status in gateway.sources[0].fan_out.outputs}
                assert not losses["foxglove"]
    assert exported.keys() | {"/lab/analog/cdr", "/lab/loads/cdr"} == schemas.keys()
    for name in FRAMES:
        live = [(log.time_ns, log.data) for log in viewer.received[f"/lab/{name}"]]
        recorded = exported[f"/lab/{name}"]  # by time; events can be late
        first = min(map(live.index, recorded))
        interval = 5 if name == "forces" else 1  # arrows are drawn for some frames of a file only
        stop = first + interval * len(recorded)
        assert sorted(live[first:stop:interval]) == sorted(recorded)
    assert description.pop("frame")["frame_id"] == "lab"
    assert len(description["3d"]["labels"]) == 20
