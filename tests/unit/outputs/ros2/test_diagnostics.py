"""The status of a source as diagnostics: values, messages and levels."""

import pytest
import rtc3d

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.ros2.diagnostics import diagnostics_of
from gateway.rtc3d.parameters import Plate
from tests import statuses
from tests.ros_lab import STAMP, UTIME, RosLab, parameters, seconds
from tests.waiting import wait_until


def test_the_status_becomes_diagnostics(lab: RosLab) -> None:
    publisher = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    assert not publisher.wanted
    lab.hear("diagnostics/**")
    wait_until(lambda: publisher.wanted)
    publisher.publish(example_status())
    wait_until(lambda: lab.received["/diagnostics"])
    array = lab.received["/diagnostics"][0].message
    assert seconds(array) == STAMP
    markers, analog, zenoh, frame = array.status
    assert (markers.level, markers.name, markers.message) == (0, "rtc3d_gateway: lab 3d 6d", "streaming")
    assert markers.hardware_id == "192.0.2.20:3020"
    assert {each.key: each.value for each in markers.values}["rate (Hz)"] == "200.0"
    assert (analog.level, analog.message) == (2, "waiting to reconnect: connection refused")
    assert (zenoh.level, zenoh.name, zenoh.message) == (2, "rtc3d_gateway: lab to zenoh", "start zenohd")
    assert {each.key: each.value for each in zenoh.values} == {"sent 3d": "7", "lost: no router": "12"}
    assert (frame.level, frame.name, frame.message) == (0, "rtc3d_gateway: lab coordinate frame", "hall")
    assert {each.key: each.value for each in frame.values} == {
        "metres per unit of the server": "0.001",
        "rotation (x y z w)": "0.5 0.5 0.5 0.5",
        "translation (m)": "2.5 0.0 -1.0",
    }
    publisher.close()
    with pytest.raises(OutputError, match="closed"):
        publisher.publish(example_status())


def example_status() -> bytes:
    status = rtc3d.status_t()
    status.utime = UTIME
    status.source, status.server = "lab", "192.0.2.20:3020"
    status.frame_id, status.metres_per_unit = "hall", 0.001
    status.rotation_xyzw, status.translation_m = [0.5, 0.5, 0.5, 0.5], [2.5, 0.0, -1.0]
    status.streams = [
        statuses.stream("3d 6d", frame_rate_hz=200.0),
        statuses.stream("analog", state="waiting to reconnect", last_error="connection refused"),
    ]
    status.num_streams = 2
    status.outputs = [
        statuses.output(
            connected=False,
            problem="start zenohd",
            num_messages=1,
            messages=[statuses.count("3d", 7)],
            num_drops=1,
            drops=[statuses.loss("no router", 12, 12)],
        )
    ]
    status.num_outputs = 1
    encoded: bytes = status.encode()
    return encoded


def test_the_names_of_labels_that_ros_cannot_use_are_shown(lab: RosLab) -> None:
    lab.source(given=parameters(("Left Foot", "wand", "x" * 200), plates=(Plate("1", "left"),)))
    publisher = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    lab.hear_all()
    publisher.publish(example_status())
    wait_until(lambda: lab.received["/diagnostics"])
    names = lab.received["/diagnostics"][0].message.status[-1]
    assert (names.level, names.name) == (0, "rtc3d_gateway: lab names")
    assert {each.key: each.value for each in names.values} == {
        "6d Left Foot": "Left_Foot",
        "6d " + "x" * 100: "x" * 48,
        "force left": "force_1",
    }


def test_what_loses_messages_gets_a_warning_until_it_loses_no_more() -> None:
    def status(utime: int, lost_by_stream: int, lost_by_output: int) -> rtc3d.status_t:
        message = rtc3d.status_t()
        message.source, message.utime = "lab", utime
        message.streams = [statuses.stream("3d", drops=[statuses.loss("frame rejected", lost_by_stream, 1)])]
        message.outputs = [statuses.output(drops=[statuses.loss("queue full", lost_by_output, 1)])]
        return message

    first, second, third = status(0, 5, 7), status(1_000_000, 5, 9), status(2_000_000, 6, 9)
    late, restarted = status(5_000_001, 100, 100), status(3_000_000, 0, 1)
    assert [_levels(now, before) for now, before in ((first, None), (second, first), (third, second))] == [
        [(0, "streaming"), (0, "connected")],
        [(0, "streaming"), (1, "connected; messages lost: 2")],
        [(1, "streaming; messages lost: 1"), (0, "connected")],
    ]
    for now, before in ((late, third), (restarted, third)):
        assert _levels(now, before) == [(0, "streaming"), (0, "connected")]
    just_known = status(5_000_000, 7, 9)
    assert _levels(just_known, third) == [(1, "streaming; messages lost: 1"), (0, "connected")]


def _levels(status: object, previous: object) -> list[tuple[int, str]]:
    return [(each.level, each.message) for each in diagnostics_of(status, previous)[:-1]]


@pytest.mark.parametrize(
    ("fields", "level", "message"),
    [
        ({"state": "idle"}, 0, "idle"),
        ({"state": "no measurement"}, 1, "no measurement"),
        ({"state": "stalled"}, 2, "stalled"),
        ({"state": "connecting"}, 2, "connecting"),
        ({"state": "no measurement", "problem": "frames come"}, 1, "no measurement"),
        ({"state": "stalled", "problem": "frames come", "last_error": "late"}, 2, "stalled: late"),
        ({"state": "idle", "last_error": "late"}, 0, "idle"),
        ({"problem": "frames come, and all are rejected: x"}, 2, "frames come, and all are rejected: x"),
    ],
)
def test_the_level_of_a_stream(fields: dict[str, str], level: int, message: str) -> None:
    status = rtc3d.status_t()
    status.streams = [statuses.stream(**fields)]
    assert _levels(status, None) == [(level, message)]


def test_what_a_stream_cannot_do_and_what_is_unknown_of_the_frame_are_shown() -> None:
    """Nodes cannot use positions without a unit; no names need no status of their own."""
    status = rtc3d.status_t()
    status.source, status.frame_id, status.metres_per_unit = "lab", "hall", 0.0
    status.streams = [statuses.stream("3d", limitations=["no clock", "no parameters"])]
    stream, frame = diagnostics_of(status, None, {"6d": {}, "force": {}})
    assert (frame.level, frame.message) == (1, "hall: the server's unit of length is unknown")
    shown = {key: text for key, text in stream.values.items() if "limitation" in key}
    assert shown == {"limitation 1": "no clock", "limitation 2": "no parameters"}
