"""Batches of frames with their times, against a clock that has learnt for three seconds."""

from time import monotonic

import numpy as np
import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, ComponentType, build_component
from gateway.rtc3d.frames import Frame, build_frame, split_frame
from gateway.stream.ingest import Ingest
from gateway.stream.status import StreamStatus

BOOT_UTIME = 1_700_000_000_000_000
PERIOD_US = 5_000


def frame(number: int, *, event: bool = False) -> Frame:
    markers = np.zeros(1, ITEM_DTYPES[ComponentType.MARKERS])
    parts = [build_component(ComponentType.MARKERS, number, PERIOD_US * number, markers)]
    if event:
        events = np.zeros(1, LONG_EVENT)
        parts.append(build_component(ComponentType.EVENT, number, PERIOD_US * number, events))
    return split_frame(build_frame(parts), "big")


class Lab:
    """An intake; ``published`` are the frame numbers and component keys that got through."""

    def __init__(self, backlog: str) -> None:
        self.backlog = backlog
        self.status = StreamStatus("3d event")
        self.published: list[tuple[int, list[str]]] = []
        self.stamps: list[Stamp] = []
        self.halvings: list[int] = []
        self.restarts = 0
        stream = StreamSettings.model_validate({"components": ["all"], "backlog": backlog})
        source = SourceSettings(name="lab", host="127.0.0.1")
        self.ingest = Ingest(
            source, stream, self.status, self._publish, self.halvings.append, self._restarted
        )

    def _restarted(self) -> None:
        self.restarts += 1

    def _publish(self, frame: Frame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        self.stamps.append(stamp)
        keys = [component.type.key for component in frame.components if component.type in wanted]
        if keys:
            self.published.append((frame.components[0].frame_number, keys))

    def take(self, *frames: Frame, late_us: int = 0) -> None:
        newest = frames[-1].components[0].timestamp_us
        self.ingest.receive(list(frames), BOOT_UTIME + newest + late_us, monotonic())


@pytest.fixture(params=["latest", "all"])
async def lab(request: pytest.FixtureRequest) -> Lab:
    lab = Lab(request.param)
    for number in range(600):
        lab.take(frame(number))
    assert [number for number, _ in lab.published] == list(range(600))
    lab.published.clear()
    lab.stamps.clear()
    return lab


async def test_capture_time_is_the_servers_time_on_the_hosts_clock(lab: Lab) -> None:
    lab.take(frame(600), late_us=20_000)
    [stamp] = lab.stamps
    assert stamp.utime == BOOT_UTIME + 600 * PERIOD_US + 20_000
    assert stamp.capture_utime == pytest.approx(BOOT_UTIME + 600 * PERIOD_US, abs=500)
    assert lab.status.lag_s == pytest.approx(0.02, abs=0.001)


async def test_frames_that_come_together_but_in_time_are_all_published(lab: Lab) -> None:
    lab.take(*(frame(number) for number in range(600, 605)))
    assert [number for number, _ in lab.published] == list(range(600, 605))
    assert not lab.status.drops


async def test_while_behind_the_newest_is_published_and_no_event_is_skipped(lab: Lab) -> None:
    late = [frame(number, event=number == 602) for number in range(600, 605)]
    lab.take(*late, late_us=200_000)
    if lab.backlog == "latest":
        assert lab.published == [(602, ["event"]), (604, ["3d"])]
        assert lab.status.drops == {"skipped while behind": 4}
    else:
        assert [number for number, _ in lab.published] == list(range(600, 605))
        assert not lab.status.drops


async def test_a_restart_is_told_and_is_no_lateness(lab: Lab) -> None:
    lab.ingest.receive([frame(3)], BOOT_UTIME + 600 * PERIOD_US, monotonic())
    assert (lab.restarts, lab.status.restarts) == (1, 1)
    assert [number for number, _ in lab.published] == [3]
    assert lab.halvings == []


async def test_frames_without_components_are_counted_and_no_more(lab: Lab) -> None:
    before = lab.status.frames_in
    lab.ingest.receive([split_frame(build_frame([]), "big")], BOOT_UTIME, monotonic())
    assert lab.status.frames_in == before + 1
    assert not lab.published
