"""The takes output behind a fan-out: it gets messages while something is recorded, and counts only those."""

import asyncio
from pathlib import Path

from gateway.messages.encode import Stamp
from gateway.outputs.takes.output import TakesOutput
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import split_frame
from tests.support.memory_output import MemoryOutput
from tests.support.recording_output import frames, settings_in
from tests.support.vectors import FULL_FRAME
from tests.support.waiting import wait_until_async

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
ALL = frozenset(WIRE_ORDER)
FULL = split_frame(FULL_FRAME["big"], "big")


def counts(fan_out: FanOut) -> dict[str, int]:
    return {name: count for output, status in fan_out.outputs for name, count in status.messages.items()
            if output.name == "takes"}  # fmt: skip


async def test_an_idle_output_gets_and_counts_nothing(tmp_path: Path) -> None:
    memory, takes = MemoryOutput(), TakesOutput(settings_in(tmp_path, components=["3d", "event"]))
    memory.start()
    takes.start()
    fan_out = FanOut("lab", [memory, takes])
    await wait_until_async(lambda: _is_open(takes))

    def publish() -> None:
        fan_out.publish(FULL, STAMP, ALL)
        fan_out.publish_status(b"status of the source")
        fan_out.publish_clock(b"clock of the source")

    publish()
    assert counts(fan_out) == {}
    assert not fan_out.has_subscribers([ComponentType.MARKERS]) or memory.has_subscriber
    memory.has_subscriber = False
    assert not fan_out.has_subscribers(WIRE_ORDER)
    await takes.takes("lab").start("walk")
    assert fan_out.has_subscribers([ComponentType.MARKERS])
    assert not fan_out.has_subscribers([ComponentType.ANALOG])
    before = len(memory.messages)
    for _ in range(3):
        publish()
    assert counts(fan_out) == {"3d": 3, "event": 3, "status": 3, "clock": 3}
    await takes.takes("lab").stop()
    publish()
    assert counts(fan_out) == {"3d": 3, "event": 3, "status": 3, "clock": 3}
    recorded = {("3d",), ("event",), ("status",), ("clock",)}
    published = [
        message for topic, message in [*memory.messages][before : before + 21] if topic.path in recorded
    ]
    assert frames(tmp_path / "lab" / "walk.lcmlog") == published
    await asyncio.to_thread(takes.close)


def _is_open(takes: TakesOutput) -> bool:
    takes.maintain()
    return takes.health().connected
