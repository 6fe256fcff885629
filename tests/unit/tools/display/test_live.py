"""What live data know about a source, from the messages that arrive."""

import pytest

from gateway.client import queued_reception
from gateway.client.queued_reception import DescribedSource, QueuedMessage, QueuedSeries
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ComponentType
from gateway.tools.display.live import NUM_EVENTS, LiveComponent, LiveData
from tests.support.takes import frame
from tests.unit.tools.display.live_lab import MISSING, Lab, wait

MARKERS = ComponentType.MARKERS
ONE = (1, 2, 3, 0.1)


def test_a_batch_has_everything_since_the_last_update() -> None:
    lab = Lab()
    for number in range(3):
        lab.send(MARKERS, [(number, 2, 3, 0), (4, 5, 6, 0)])
    component = lab.source.components["3d"]
    assert component.batch.heads["sequence"].tolist() == [0, 1, 2]
    assert component.batch.items[2]["x"].tolist() == [[0, 4], [1, 4], [2, 4]]
    assert component.newest_items["y"].tolist() == [2, 5]
    assert not len(lab.source.components["3d"].batch.heads)
    assert component.newest_items["x"].tolist() == [2, 4]


def test_the_number_of_items_may_change_within_a_batch() -> None:
    lab = Lab()
    lab.send(MARKERS, [ONE])
    lab.send(MARKERS, [ONE, ONE])
    component = lab.source.components["3d"]
    assert {count: items.shape for count, items in component.batch.items.items()} == {1: (1, 1), 2: (1, 2)}
    assert len(component.newest_items) == 2


def test_parameters_give_labels_unit_and_rate() -> None:
    lab = Lab()
    lab.send(MARKERS, [ONE, ONE])
    assert lab.source.components["3d"].description.labels == ("marker 1", "marker 2")
    lab.send_labels("LASI", "RASI")
    source = lab.source
    assert source.parameters_version == 1
    assert source.components["3d"].description.labels == ("LASI", "RASI")
    assert source.components["3d"].announced_rate_hz == 200


def test_parameters_that_cannot_be_read_are_counted() -> None:
    lab = Lab()
    lab.send_parameters("<a>")
    assert lab.source.num_unreadable == 1
    assert lab.source.num_unreadable == 1


def test_the_share_of_frames_in_which_a_marker_is_visible() -> None:
    lab = Lab()
    for number in range(4):
        lab.send(MARKERS, [MISSING if number else ONE, ONE])
    assert lab.source.components["3d"].visible_shares.tolist() == [0.25, 1.0]


def test_latencies_are_those_of_the_times_in_the_messages() -> None:
    lab = Lab()
    for _ in range(10):
        lab.send(MARKERS, [ONE], utime=now_utime() - 60_000_000)
    latency = lab.source.components["3d"].latency
    assert latency.to_gateway is not None
    assert latency.to_here is not None
    assert latency.to_gateway.p50_ms == latency.to_gateway.p99_ms == 2.0
    assert 60_000 <= latency.to_here.p50_ms <= latency.to_here.p99_ms < 120_000


def test_events_are_kept_by_their_order() -> None:
    lab = Lab()
    for number in range(30):
        lab.send(ComponentType.EVENT, [(number, 0, 0, 0, 0)])
        lab.send(ComponentType.EVENT, [])
    source = lab.source
    assert [event.text.label for event in source.events] == [
        f"event {number}" for number in range(30 - NUM_EVENTS, 30)
    ]
    assert not source.is_stopped


def test_data_that_come_no_more_have_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    lab.send(MARKERS, [ONE])
    before = lab.source
    assert not before.is_stopped
    wait(monkeypatch, 0.6)
    stopped = lab.source
    assert stopped.is_stopped
    lab.send(MARKERS, [ONE])
    after = lab.source
    assert not after.is_stopped


def test_messages_that_nobody_decodes_are_skipped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queued_reception, "MAX_WAITING", 5)
    lab = Lab()
    for _ in range(8):
        lab.send(MARKERS, [ONE])
    source = lab.source
    assert source.num_skipped == 3
    assert source.components["3d"].batch.heads["sequence"].tolist() == [3, 4, 5, 6, 7]


def test_a_message_of_the_wrong_length_is_counted() -> None:
    component = LiveComponent(MARKERS)
    _, whole = frame(MARKERS, [ONE])
    series = QueuedSeries(DescribedSource("lab", "MOCAP_LAB"), "3d", "MOCAP_LAB_3D")
    component.update([QueuedMessage(series, each, 0, 0) for each in (whole, whole[:-1], whole[:45])], None)
    assert component.num_malformed == 2
    assert component.newest_items["x"].tolist() == [1]


def test_sources_are_sorted_and_know_their_status() -> None:
    live = LiveData()
    for name in ("stage", "lab"):
        Lab(name, live).send_status()
    lab, stage = live.update()
    assert (lab.name, stage.name) == ("lab", "stage")
    assert lab.report is not None
    assert lab.report.name == "lab"
    assert not lab.is_silent
