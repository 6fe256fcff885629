"""The status of a source as diagnostics: values, messages and levels."""

from typing import Any

import pytest
import rtc3d

from gateway.messages.ros2.encode import DiagnosticStatus
from gateway.messages.source_report import source_report
from gateway.messages.topics import Topic
from gateway.outputs.adapters.ros2 import diagnostics as diagnostics_module
from gateway.outputs.adapters.ros2.diagnostics import DiagnosticsPublisher, diagnostics_of
from gateway.outputs.contract import IgnoringPublisher
from gateway.rtc3d.parameters import Plate
from tests.support import ros_messages as ros
from tests.support import statuses
from tests.support.ros_lab import UTIME, parameters
from tests.unit.outputs.adapters.ros2.scripted_ros import cause_of
from tests.unit.outputs.adapters.ros2.test_output import Output


def a_status(
    *, streams: list[Any] | None = None, outputs: list[Any] | None = None, **fields: Any
) -> rtc3d.status_t:
    status = rtc3d.status_t()
    status.source, status.server, status.frame_id = "lab", "192.0.2.20:3020", "hall"
    status.streams, status.outputs = streams or [], outputs or []
    status.num_streams, status.num_outputs = len(status.streams), len(status.outputs)
    for name, value in fields.items():
        setattr(status, name, value)
    return status


def test_the_status_becomes_diagnostics() -> None:
    drops = [statuses.loss("no router", 12, 12)]
    status = a_status(
        streams=[
            statuses.stream("3d 6d", frame_rate_hz=200.0, limitations=["no clock", "no parameters"]),
            statuses.stream("analog", state="waiting to reconnect", last_error="connection refused"),
        ],
        outputs=[
            statuses.output(
                connected=False, problem="start zenohd", messages=[statuses.count("3d", 7)], drops=drops
            )
        ],
        metres_per_unit=0.001,
        rotation_xyzw=[0.5, 0.5, 0.5, 0.5],
        translation_m=[2.5, 0.0, -1.0],
    )
    markers, analog, zenoh, frame = diagnostics_of(source_report(status))
    assert markers[:4] == (0, "rtc3d_gateway: lab 3d 6d", "streaming", "192.0.2.20:3020")
    shown = {"rate (Hz)": "200.0", "limitation 1": "no clock", "limitation 2": "no parameters"}
    assert shown.items() <= markers.values.items()
    assert analog[::2][:2] == (2, "waiting to reconnect: connection refused")
    assert zenoh[:3] == (2, "rtc3d_gateway: lab to zenoh", "start zenohd")
    assert zenoh.values == {"sent 3d": "7", "lost: no router": "12"}
    assert frame[:3] == (0, "rtc3d_gateway: lab coordinate frame", "hall")
    assert frame.values == {
        "metres per unit of the server": "0.001",
        "rotation (x y z w)": "0.5 0.5 0.5 0.5",
        "translation (m)": "2.5 0.0 -1.0",
    }
    # Nodes cannot use positions without a unit; no names need no status of their own.
    [frame] = diagnostics_of(source_report(a_status(metres_per_unit=0.0)), None, {"6d": {}, "force": {}})
    assert (frame.level, frame.message) == (1, "hall: the server's unit of length is unknown")


def test_what_loses_messages_gets_a_warning_until_it_loses_no_more() -> None:
    def status(utime: int, lost_by_stream: int, lost_by_output: int) -> rtc3d.status_t:
        stream = statuses.stream("3d", drops=[statuses.loss("frame rejected", lost_by_stream, 1)])
        output = statuses.output(drops=[statuses.loss("queue full", lost_by_output, 1)])
        return a_status(streams=[stream], outputs=[output], utime=utime)

    first, second, third = status(0, 5, 7), status(1_000_000, 5, 9), status(2_000_000, 6, 9)
    unchanged, one_lost = (0, "streaming"), (1, "streaming; messages lost: 1")
    for now, before, expected in (
        (first, None, [unchanged, (0, "connected")]),
        (second, first, [unchanged, (1, "connected; messages lost: 2")]),
        (third, second, [one_lost, (0, "connected")]),
        (status(5_000_000, 7, 9), third, [one_lost, (0, "connected")]),  # is just known
        (status(5_000_001, 100, 100), third, [unchanged, (0, "connected")]),  # is too late
        (status(3_000_000, 0, 1), third, [unchanged, (0, "connected")]),  # began again
    ):
        assert _levels(now, before) == expected


def _levels(status: rtc3d.status_t, previous: rtc3d.status_t | None = None) -> list[tuple[int, str]]:
    before = source_report(previous) if previous is not None else None
    return [(each.level, each.message) for each in diagnostics_of(source_report(status), before)[:-1]]


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
    assert _levels(a_status(streams=[statuses.stream(**fields)])) == [(level, message)]


def test_a_status_is_published_while_somebody_subscribes(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the names of labels that ROS cannot use. What cannot be sent is refused with its cause."""
    lab = Output(monkeypatch)
    assert isinstance(lab.output.publisher(Topic("lab", ("clock",), "rtc3d.clock_t")), IgnoringPublisher)
    lab.output.frame_publisher("lab")
    tools = ("Left Foot", "wand", "x" * 200)
    lab.output.publish_parameters("lab", parameters(tools, plates=(Plate("1", "left"),)))
    lab.sender.run()
    publisher = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    assert isinstance(publisher, DiagnosticsPublisher)
    status: bytes = a_status(utime=UTIME).encode()
    publisher.publish(status)
    assert (publisher.wanted, lab.sender.calls) == (False, [])
    lab.output._diagnostics._on_matching(True)
    assert publisher.wanted
    publisher.publish(status)
    assert lab.sender.offered_bytes[-1] == len(status)
    lab.sender.run()
    [cdr] = lab.node.messages["/diagnostics"]
    array = ros.decoded(cdr, "diagnostic_msgs/msg/DiagnosticArray")
    assert array.header == ros.header(UTIME, "")
    names = array.status[-1]
    assert (names.level, names.name) == (0, "rtc3d_gateway: lab names")
    assert {each.key: each.value for each in names.values} == {
        "6d Left Foot": "Left_Foot",
        "6d " + "x" * 100: "x" * 48,
        "force left": "force_1",
    }
    seen: list[Any] = []

    def note(now: object, before: object, _names: object) -> list[DiagnosticStatus]:
        seen.append((now, before))
        return []

    monkeypatch.setattr(diagnostics_module, "diagnostics_of", note)
    publisher.publish(status)
    publisher.publish(status)
    lab.sender.run()
    assert lab.node.sent == {"/diagnostics": [1, 2, 3]}
    assert seen[1][1] is seen[0][0]
    lab.sender.is_full = True
    assert cause_of(publisher.publish, status) == "queue full"
    lab.router.is_cut_off = True
    assert cause_of(publisher.publish, status) == "no router"
    publisher.close()
    assert cause_of(publisher.publish, status) == "closed"
    assert not publisher.wanted
