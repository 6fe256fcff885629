import struct
import time

import numpy as np
import pytest
import rtc3d

from gateway.client.series import FINGERPRINTS
from gateway.display.live import component as live_component
from gateway.display.live.component import LiveComponent
from gateway.display.live.live_data import NUM_EVENTS, LiveData, LiveSource
from gateway.messages.encode import PREFIX
from gateway.messages.host_time import now_utime
from gateway.outputs.contract import ServerParameters
from gateway.outputs.parameters_message import encode_parameters
from gateway.rtc3d.components import ITEM_DTYPES, MISSING, ComponentType

XML = b"""<Parameters><The_3D><Markers>2</Markers><Frequency>200</Frequency>
<Marker><Label>LASI</Label></Marker><Marker><Label>RASI</Label></Marker></The_3D></Parameters>"""


def message(key: str, sequence: int, items: np.ndarray, *, delay_us: int = 0) -> bytes:
    utime = now_utime() - delay_us
    head = FINGERPRINTS[key] + PREFIX.pack(utime, utime - 2000, sequence, 1, 1)
    return head + struct.pack(">iqi", sequence, 5000 * sequence, len(items)) + items.tobytes()


def markers(*positions: tuple[float, float, float]) -> np.ndarray:
    items = np.zeros(len(positions), ITEM_DTYPES[ComponentType.MARKERS])
    for index, position in enumerate(positions):
        for name, value in zip("xyz", position, strict=True):
            items[name][index] = value
    return items


def events(*ids: int) -> np.ndarray:
    items = np.zeros(len(ids), ITEM_DTYPES[ComponentType.EVENT])
    items["id"] = ids
    return items


def only(live: LiveData) -> LiveSource:
    [source] = live.update()
    return source


def test_a_batch_has_everything_since_the_last_update() -> None:
    live = LiveData()
    for number in range(3):
        live.publish("lab", "3d", message("3d", number, markers((number, 2, 3), (4, 5, 6))))
    component = only(live).components["3d"]
    assert component.batch.heads["sequence"].tolist() == [0, 1, 2]
    assert component.batch.items[2]["x"].tolist() == [[0, 4], [1, 4], [2, 4]]
    assert component.newest_items["y"].tolist() == [2, 5]
    assert not len(only(live).components["3d"].batch.heads)
    assert component.newest_items["x"].tolist() == [2, 4]


def test_the_number_of_items_may_change_within_a_batch() -> None:
    live = LiveData()
    live.publish("lab", "3d", message("3d", 0, markers((1, 2, 3))))
    live.publish("lab", "3d", message("3d", 1, markers((1, 2, 3), (4, 5, 6))))
    component = only(live).components["3d"]
    assert {count: items.shape for count, items in component.batch.items.items()} == {1: (1, 1), 2: (1, 2)}
    assert len(component.newest_items) == 2


def test_parameters_give_labels_unit_and_rate() -> None:
    live = LiveData()
    live.publish("lab", "3d", message("3d", 0, markers((1, 2, 3), (4, 5, 6))))
    assert only(live).components["3d"].description.labels == ("marker 1", "marker 2")
    parameters = encode_parameters(ServerParameters(XML, 1, 4), utime=1, arrived_utime=1, sequence=0)
    live.publish("lab", "parameters", parameters)
    source = only(live)
    assert source.parameters_version == 4
    assert source.components["3d"].description.labels == ("LASI", "RASI")
    assert source.components["3d"].announced_rate_hz == 200


def test_parameters_that_cannot_be_read_are_counted() -> None:
    live = LiveData()
    broken = encode_parameters(ServerParameters(b"<a>", 1, 4), utime=1, arrived_utime=1, sequence=0)
    live.publish("lab", "parameters", broken)
    source = only(live)
    assert source.num_unreadable == 1
    assert only(live).num_unreadable == 1


def test_the_share_of_frames_in_which_a_marker_is_visible() -> None:
    live = LiveData()
    for number in range(4):
        x = float(MISSING) if number else 1.0
        live.publish("lab", "3d", message("3d", number, markers((x, 2, 3), (4, 5, 6))))
    shares = only(live).components["3d"].visible_shares
    assert shares.tolist() == [0.25, 1.0]


def test_latencies_are_those_of_the_times_in_the_messages() -> None:
    live = LiveData()
    for number in range(10):
        live.publish("lab", "3d", message("3d", number, markers((1, 2, 3)), delay_us=60_000_000))
    latency = only(live).components["3d"].latency
    assert latency.to_gateway is not None
    assert latency.to_here is not None
    assert latency.to_gateway.p50_ms == latency.to_gateway.p99_ms == 2.0
    assert 60_000 <= latency.to_here.p50_ms <= latency.to_here.p99_ms < 120_000


def test_events_are_kept_by_their_order() -> None:
    live = LiveData()
    for number in range(30):
        live.publish("lab", "event", message("event", number, events(number)))
        live.publish("lab", "event", message("event", number, events()))
    source = only(live)
    assert [event.text.label for event in source.events] == [
        f"event {number}" for number in range(30 - NUM_EVENTS, 30)
    ]
    assert not source.is_stopped


def test_data_that_come_no_more_have_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    live = LiveData()
    live.publish("lab", "3d", message("3d", 0, markers((1, 2, 3))))
    source = only(live)
    assert not source.is_stopped
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 0.6)
    assert only(live).is_stopped
    live.publish("lab", "3d", message("3d", 1, markers((1, 2, 3))))
    assert not only(live).is_stopped


def test_messages_that_nobody_decodes_are_skipped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_component, "MAX_WAITING", 5)
    live = LiveData()
    for number in range(8):
        live.publish("lab", "3d", message("3d", number, markers((number, 2, 3))))
    source = only(live)
    assert source.num_skipped == 3
    assert source.components["3d"].batch.heads["sequence"].tolist() == [3, 4, 5, 6, 7]


def test_a_message_of_the_wrong_length_is_counted() -> None:
    component = LiveComponent(ComponentType.MARKERS)
    whole = message("3d", 0, markers((1, 2, 3)))
    component.update([(whole, 0), (whole[:-1], 0), (whole[:45], 0)], None)
    assert component.num_malformed == 2
    assert component.newest_items["x"].tolist() == [1]


def test_sources_are_sorted_and_know_their_status() -> None:
    live = LiveData()
    for name in ("stage", "lab"):
        status = rtc3d.status_t()
        status.source = name
        live.publish(name, "status", status.encode())
    lab, stage = live.update()
    assert (lab.name, stage.name) == ("lab", "stage")
    assert lab.report is not None
    assert lab.report.name == "lab"
    assert not lab.is_silent
