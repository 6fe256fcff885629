"""Takes that peers start, stop, list and read."""

from pathlib import Path

import lcm

from gateway.messages.decode import decode
from gateway.outputs.contract import ServerParameters
from tests.recording_output import events, frames, recording_lab


async def test_a_take_has_everything_that_is_published_between_start_and_stop(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        lab.publish()
        started = await lab.takes.start("lab", "walk 1")
        published = [lab.publish(key) for _ in range(50) for key in ("3d", "event")]
        stopped = await lab.takes.stop("lab")
        lab.publish()
    assert frames(lab.path("walk 1.lcmlog")) == published
    assert (started.name, started.is_running, stopped.name, stopped.is_running) == (
        "walk 1",
        True,
        "walk 1",
        False,
    )
    assert stopped.num_bytes == lab.path("walk 1.lcmlog").stat().st_size
    assert stopped.begin_utime == started.begin_utime
    log = lcm.EventLog(str(lab.path("walk 1.lcmlog")))
    assert [event.channel for event in log][:3] == ["MOCAP_LAB_TAKE", "MOCAP_LAB_3D", "MOCAP_LAB_EVENT"]


async def test_a_take_begins_with_its_description_and_the_newest_parameters(tmp_path: Path) -> None:
    async with recording_lab(tmp_path) as lab:
        lab.takes.server = lambda source: f"{source}:3020"
        lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
        lab.output.publish_parameters("lab", ServerParameters(b"<new/>\0", 1, 5))
        await lab.takes.start("lab", "walk")
        lab.publish()
        lab.output.publish_parameters("lab", ServerParameters(b"<changed/>", 1, 6))
        lab.publish()
        await lab.takes.stop("lab")
    take, new, first, changed, second = events(lab.path("walk.lcmlog"))
    description = decode(take.message)
    assert (description.name, description.source, description.channels) == ("walk", "lab", "MOCAP_LAB")
    assert description.server == "lab:3020"
    assert decode(new.message).xml == "<new/>"
    assert decode(changed.message).xml == "<changed/>"
    assert (new.channel, changed.channel) == ("MOCAP_LAB_PARAMETERS", "MOCAP_LAB_PARAMETERS")
    times = [event.utime for event in (take, new, first, changed, second)]
    assert times == sorted(times)


async def test_saving(tmp_path: Path) -> None:
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        published = [lab.publish() for _ in range(10)]
        await lab.takes.save("lab", 30, 0, "fall")
        lab.publish()
    assert frames(lab.path("fall")) == published
