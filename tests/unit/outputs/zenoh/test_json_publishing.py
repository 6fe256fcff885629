"""The keys with JSON: who gets them, how often, and what is counted."""

import functools
import itertools
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rtc3d

from gateway.messages.decode import MAX_JSON_SOURCE_BYTES, decode, to_json
from gateway.messages.encode import MESSAGE_TYPES, lcm_type_name
from gateway.messages.topics import Topic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.pacing import Pacer
from gateway.outputs.zenoh.json_publishing import MAX_DESCRIPTION_CHARACTERS, JsonConverter
from gateway.outputs.zenoh.publisher import ZenohPublisher
from gateway.rtc3d.components import MISSING, ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from tests.support.parameters import ALL as SPEC_PARAMETERS
from tests.support.takes import START_UTIME, frame, markers
from tests.support.waiting import wait_until
from tests.unit.outputs.zenoh.lab import Lab, with_settings

JSON = "mocap/lab/*/json"


class JsonLab(Lab):
    """An open output, and a web page that subscribes to JSON."""

    def publisher(self, component: ComponentType = ComponentType.MARKERS) -> ZenohPublisher:
        """Return a publisher whose messages are wanted."""
        type_name = lcm_type_name(MESSAGE_TYPES[component])
        publisher = self.output.publisher(Topic("lab", (component.key,), type_name))
        wait_until(lambda: publisher.wanted)
        return publisher

    def set_parameters(self, parameters: Parameters, version: int = 1) -> None:
        self.output.publish_parameters("lab", ServerParameters(b"", 1, version, parsed=parameters))

    @property
    def received(self) -> list[dict[str, Any]]:
        return [json.loads(sample.payload.to_string()) for sample in list(self.samples)]

    def received_of(self, publisher: ZenohPublisher, message: bytes) -> dict[str, Any]:
        """Publish a message; return its JSON."""
        self.samples.clear()
        publisher.publish(message)
        wait_until(lambda: self.samples)
        [received] = self.received
        return received


@pytest.fixture
def lab(settings: dict[str, Any]) -> Iterator[JsonLab]:
    lab = JsonLab(**settings)
    lab.open()
    yield lab
    lab.close()


@pytest.fixture
def publisher(lab: JsonLab) -> ZenohPublisher:
    """The publisher of the markers, whose JSON is wanted."""
    lab.subscribe(JSON)
    return lab.publisher()


def event(sequence: int) -> bytes:
    return frame(ComponentType.EVENT, [(7, sequence, 1, 2, 3)], sequence)[1]


# Content ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("component", "items", "description"),
    [
        (
            ComponentType.MARKERS,
            [(1.5, 2, 3, 0.1), (MISSING, MISSING, MISSING, 999)],
            {"labels": ["marker 1", "marker 2"], "units": ["mm", "mm"]},
        ),
        (ComponentType.ANALOG, [0.25, MISSING], {"labels": ["EMG1", "channel 2"], "units": ["mV", "mV"]}),
        (
            ComponentType.FORCE,
            [(1, 2, 3, 4, 5, 6)],
            {"labels": ["First force plate"], "units": ["N"], "moment_unit": ""},  # no moments are described
        ),
        (
            ComponentType.EVENT,
            [(0x123456, 5000, 1, 2, 3), (9, 5000, 1, 2, 3)],
            {"labels": ["Button", ""]},
        ),
    ],
    ids=lambda each: each.key if isinstance(each, ComponentType) else "",
)
def test_a_component_as_json_has_the_fields_of_its_message_and_labels_and_units(
    lab: JsonLab, component: ComponentType, items: list[Any], description: dict[str, Any]
) -> None:
    lab.set_parameters(SPEC_PARAMETERS)
    lab.subscribe(JSON)
    _, message = frame(component, items)
    assert lab.received_of(lab.publisher(component), message) == {**to_json(decode(message)), **description}
    [sample] = lab.samples
    assert str(sample.key_expr) == f"mocap/lab/{component.key}/json"
    assert str(sample.encoding) == "application/json"


def test_the_pose_of_a_tool_is_on_a_key_of_its_own_and_has_its_label(lab: JsonLab) -> None:
    lab.subscribe("mocap/lab/6d/*/json")
    publisher = lab.output.publisher(Topic("lab", ("6d", "Probe 1"), "rtc3d.tool_pose_t"))
    wait_until(lambda: publisher.wanted)
    pose: Any = rtc3d.tool_pose_t()
    pose.visible, pose.position_m = False, [float("nan")] * 3
    received = lab.received_of(publisher, pose.encode())
    assert str(lab.samples[0].key_expr) == "mocap/lab/6d/Probe%201/json"
    assert (received["label"], received["visible"]) == ("Probe 1", False)
    assert received["position_m"] == [None] * 3


def test_labels_are_those_of_the_parameters_that_describe_the_frame(
    lab: JsonLab, publisher: ZenohPublisher
) -> None:
    named = Parameters(markers=Parameters3D(markers=(Marker("1", "C7"), Marker("2", "C7"))))

    def labels(num_markers: int, sequence: int, version: int) -> list[str] | None:
        _, message = markers(num_markers, sequence, version=version)
        found: list[str] | None = lab.received_of(publisher, message).get("labels")
        return found

    assert labels(2, 0, 2) is None
    lab.set_parameters(named, 2)
    assert labels(2, 10, 2) == ["C7", "C7_2"]
    assert labels(1, 20, 2) == ["C7"]
    lab.set_parameters(Parameters(markers=Parameters3D(markers=(Marker("1", '足"\\\n'),))), 3)
    assert labels(2, 30, 2) is None
    assert labels(2, 40, 3) == ['足"\\', "marker 2"]


def test_labels_that_are_too_long_together_are_left_out(lab: JsonLab, publisher: ZenohPublisher) -> None:
    num_labels = MAX_DESCRIPTION_CHARACTERS // 200 + 1
    many = tuple(Marker(str(at), f"{at:0200}") for at in range(num_labels))
    lab.set_parameters(Parameters(markers=Parameters3D(markers=many)))
    assert "labels" in lab.received_of(publisher, markers(10)[1])
    received = lab.received_of(publisher, markers(num_labels, 10)[1])
    assert (len(received["markers"]), "labels" in received) == (num_labels, False)


# Who gets it ----------------------------------------------------------------------------------------


def test_a_component_is_wanted_while_somebody_subscribes_to_its_json_alone(lab: JsonLab) -> None:
    publisher = lab.output.publisher(Topic("lab", ("3d",), "rtc3d.markers_t"))
    other = lab.output.publisher(Topic("lab", ("6d",), "rtc3d.tools_t"))
    assert not publisher.wanted
    subscriber = lab.subscribe("mocap/lab/3d/json")
    wait_until(lambda: publisher.wanted)
    assert not other.wanted
    subscriber.undeclare()
    wait_until(lambda: not publisher.wanted)


def test_a_missed_notification_of_subscribers_is_made_up_for(lab: JsonLab) -> None:
    lab.subscribe("mocap/lab/3d/json")
    publisher = lab.publisher()
    assert publisher.json is not None
    publisher.json.wanted = publisher.wanted = False  # as if Zenoh had not notified
    lab.output.maintain()
    assert publisher.wanted
    lab.received_of(publisher, markers(1)[1])


def test_no_json_is_made_for_subscribers_of_the_messages_nor_of_the_status(lab: JsonLab) -> None:
    lab.subscribe("mocap/lab/*")
    publisher = lab.publisher()
    publisher.publish(markers(1)[1])
    wait_until(lambda: lab.samples)
    assert publisher.json is not None
    assert not publisher.json.wanted
    assert lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t")).json is None
    assert str(lab.samples[0].key_expr) == "mocap/lab/3d"


@with_settings(json_max_rate_hz=0.0)
def test_a_rate_of_0_switches_it_off(lab: JsonLab) -> None:
    lab.subscribe("mocap/**")
    publisher = lab.publisher()
    publisher.publish(markers(1)[1])
    publisher.publish(markers(1, 1)[1])
    wait_until(lambda: len(lab.samples) >= 2)
    assert {str(sample.key_expr) for sample in lab.samples} == {"mocap/lab/3d"}
    assert publisher.json is None


def test_a_closed_publisher_is_not_wanted_and_sends_nothing(lab: JsonLab, publisher: ZenohPublisher) -> None:
    publisher.close()
    lab.output.maintain()
    assert not publisher.wanted
    assert lab.received_of(lab.publisher(), markers(3)[1])["num_markers"] == 3


# How often ---------------------------------------------------------------------------------------------


@with_settings(json_max_rate_hz=400.0)
def test_frames_are_left_out_at_even_intervals_of_their_capture(
    lab: JsonLab, publisher: ZenohPublisher
) -> None:
    """Of 1000 frames per second, those that the pacer picks; nothing is lost."""
    pacer = Pacer(400.0)
    expected = []
    for number in range(200):
        utime = START_UTIME + 1000 * number
        publisher.publish(markers(1, number, utime=utime)[1])
        if pacer.due(utime - 2000, utime):
            expected.append(number)
            wait_until(lambda: len(lab.samples) == len(expected))
    assert [received["sequence"] for received in lab.received] == expected
    assert len(expected) == 80
    assert lab.lost == {}


@with_settings(json_max_rate_hz=20.0)
def test_a_fast_replay_makes_no_more_json_per_second(lab: JsonLab, publisher: ZenohPublisher) -> None:
    """These messages were captured within 100 s."""
    begun_s = time.monotonic()
    for number in range(10_000):
        publisher.publish(markers(1, number)[1])
    publisher.publish(markers(1, 20_000)[1])
    most = 20 * (time.monotonic() - begun_s + 0.25) + 1
    wait_until(lambda: lab.samples)
    lab.output.close()
    assert len(lab.samples) <= most
    assert lab.lost == {}


@with_settings(json_max_rate_hz=1000.0)
def test_what_waits_is_replaced_by_the_newest_frame(lab: JsonLab, publisher: ZenohPublisher) -> None:
    for number in range(200):
        publisher.publish(markers(100, number)[1])
    wait_until(lambda: any(received["sequence"] == 199 for received in lab.received))
    numbers = [received["sequence"] for received in lab.received]
    assert numbers == sorted(numbers)
    assert len(numbers) < 200
    assert lab.lost == {}


@with_settings(json_max_rate_hz=1.0)
def test_no_event_is_left_out(lab: JsonLab) -> None:
    lab.subscribe(JSON)
    publisher = lab.publisher(ComponentType.EVENT)
    for number in range(500):
        publisher.publish(event(number))
    wait_until(lambda: len(lab.samples) >= 500)
    assert [received["sequence"] for received in lab.received] == list(range(500))
    assert lab.lost == {}


# Sources ------------------------------------------------------------------------------------------------


def wait_for(event: threading.Event) -> None:
    event.wait()


def test_sources_that_wait_share_the_time_of_the_thread_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr("gateway.outputs.zenoh.json_publishing.time.monotonic", lambda: now_s)
    converted: list[str] = []
    keys, can_begin = JsonConverter(1.0), threading.Event()

    def convert(source: str, duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s
        converted.append(source)

    assert keys.offer("crowd", functools.partial(wait_for, can_begin), 1)
    for source, duration_s, count in (("crowd", 0.008, 3), ("lab", 0.002, 6)):
        for _ in range(count):
            assert keys.offer(source, functools.partial(convert, source, duration_s), 1)
    can_begin.set()
    wait_until(lambda: len(converted) == 9)
    assert "".join(source[0] for source in converted) == "cllllcllc"
    keys.close()


def test_what_waits_of_one_source_is_bounded_and_leaves_room_for_the_others() -> None:
    keys, can_begin = JsonConverter(1.0), threading.Event()
    assert keys.offer("crowd", functools.partial(wait_for, can_begin), 1)
    for source in ("crowd", "lab"):
        while keys.offer(source, lambda: None, 0):
            pass
    assert keys.offer("yard", lambda: None, 1 << 30)
    assert not keys.offer("yard", lambda: None, 1)
    can_begin.set()
    keys.close()


# What is refused -----------------------------------------------------------------------------------------


def test_events_that_come_faster_than_they_can_be_converted_are_counted(lab: JsonLab) -> None:
    lab.subscribe(JSON)
    publisher = lab.publisher(ComponentType.EVENT)
    many = frame(ComponentType.EVENT, [(7, 0, 1, 2, 3)] * 2000)[1]
    for _ in range(2000):
        publisher.publish(many)  # together more bytes than may wait
    assert set(lab.lost) == {"json queue full"}
    assert lab.lost["json queue full"][0] > 100


def test_after_a_full_queue_the_next_frame_is_sent(
    lab: JsonLab, publisher: ZenohPublisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as full:
        full.setattr(lab.output._json, "offer", lambda *_: False)
        publisher.publish(markers(1)[1])
    assert lab.lost == {"json queue full": (1, 0)}
    assert lab.received_of(publisher, markers(1, 100)[1])["sequence"] == 100


def test_a_frame_that_is_too_long_is_counted_and_published_without_json(lab: JsonLab) -> None:
    lab.subscribe("mocap/**")
    publisher = lab.publisher()
    _, message = markers(MAX_JSON_SOURCE_BYTES // 16)

    def keys_after(message: bytes) -> set[str]:
        publisher.publish(message)
        return {str(sample.key_expr) for sample in lab.samples}

    # Zenoh drops a long message if the machine is busy, and further ones while long ones fill its queue.
    wait_until(lambda: keys_after(message) and lab.lost)
    assert {str(sample.key_expr) for sample in lab.samples} == {"mocap/lab/3d"}
    assert lab.lost.keys() == {"json too long"}
    numbers = itertools.count(100)  # a message with the time of an earlier one would be left out
    wait_until(lambda: "mocap/lab/3d/json" in keys_after(markers(1, next(numbers))[1]))


def test_a_message_that_cannot_be_decoded_is_counted(lab: JsonLab, publisher: ZenohPublisher) -> None:
    publisher.publish(b"no message")
    wait_until(lambda: lab.lost == {"json failed": (1, 0)})
    assert lab.received_of(publisher, markers(1)[1])


def test_closing_does_not_wait_for_what_is_to_be_converted(lab: JsonLab) -> None:
    lab.subscribe(JSON)
    publisher = lab.publisher(ComponentType.EVENT)
    for number in range(1000):
        publisher.publish(event(number))
    lab.output.close()
    assert len(lab.samples) < 1000
    assert publisher.json is not None
    publisher.json._send(event(1000))  # as if the session had been closed meanwhile
    assert lab.lost == {}
