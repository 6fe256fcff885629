"""What the output for ROS 2 cannot publish: it is counted, and the next frame is published."""

import json
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.ros2.message_types import TF_MESSAGE
from gateway.outputs.ros2.source_topics import MAX_PLATES, MAX_TOOLS, SourceTopics
from gateway.outputs.ros2.topic import RosTopic
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Plate
from tests.networks import zenoh_keys
from tests.ros_lab import ALL, ONE_TOOL, RosLab, frame_of, parameters, ros_lab, stamp, tools_frame
from tests.waiting import wait_until


def test_an_unknown_unit_publishes_no_positions_and_is_counted(lab: RosLab) -> None:
    frame = CoordinateFrame("lab", None)
    given = parameters(("wand",), markers=1, channels=("Fx",), unit="furlong", frame=frame)
    publisher = lab.source(given=given)
    lab.hear_all()
    kinds = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), ONE_TOOL, (ComponentType.ANALOG, [1.0]))
    publisher.publish(kinds, stamp(), 0, ALL)
    wait_until(lambda: lab.received["/mocap/lab/analog"])
    assert set(lab.received) == {"/mocap/lab/analog"}
    assert lab.lost() == {"unknown unit": 3}  # the cloud, the pose, /tf
    assert "furlong" in lab.losses["lab"].report()[0].text


def test_thousands_of_labels_and_plates_are_bounded_and_counted(lab: RosLab) -> None:
    tools = tuple(f"tool {number}" for number in range(3000))
    plates = tuple(Plate(str(number)) for number in range(1000))
    publisher = lab.source(given=parameters(tools, plates=plates))
    wait_until(lambda: len(lab.topics()) == 2 + MAX_TOOLS + MAX_PLATES)
    lab.hear_all()
    publisher.publish(tools_frame(*[(1, 2, 3)] * 3000), stamp(), 0, ALL)
    publisher.publish(frame_of((ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)] * 1000)), stamp(), 1, ALL)
    wait_until(lambda: len(lab.received) == 1 + MAX_TOOLS + MAX_PLATES)
    assert len(lab.received["/tf"][0].message.transforms) == MAX_TOOLS
    assert lab.lost() == {"too many tools": 3000 - MAX_TOOLS, "too many force plates": 1000 - MAX_PLATES}


def test_items_whose_topics_are_not_open_yet_are_not_too_many() -> None:
    tf = RosTopic("/tf", TF_MESSAGE, lambda: None)
    topics = SourceTopics("lab", "/mocap/lab", tf, lambda: None)
    topics.losses = Losses(logging.getLogger("tests"), "lab to ros2")
    tf.wanted = True
    topics.send(tools_frame((1, 2, 3), (4, 5, 6)), stamp(), ALL, parameters(("wand",)))
    assert topics.losses.report() == []


def stalled(lab: RosLab) -> threading.Event:
    """Let the sending thread wait for the event that is returned."""
    may_go_on = threading.Event()

    def wait() -> None:
        may_go_on.wait(60)

    lab.output.submit(wait)
    return may_go_on


def test_frames_beyond_the_queue_are_refused_and_ros_sees_the_gap(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1, channels=("Fx",)))
    lab.hear_all()
    frame = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), (ComponentType.ANALOG, [1.0]))
    publisher.publish(frame, stamp(), 0, ALL)
    may_go_on = stalled(lab)
    while lab.output.offer(lambda: None):
        pass
    for number in range(3):
        with pytest.raises(OutputError) as refused:
            publisher.publish(frame, stamp(), number, frozenset({ComponentType.MARKERS}))
        assert refused.value.cause == "queue full"
    may_go_on.set()
    is_empty = threading.Event()
    wait_until(lambda: lab.output.offer(is_empty.set))
    assert is_empty.wait(30)
    publisher.publish(frame, stamp(), 4, ALL)
    wait_until(lambda: len(lab.received["/mocap/lab/analog"]) == 2)
    assert [each.sequence for each in lab.received["/mocap/lab/markers"]] == [1, 5]
    assert [each.sequence for each in lab.received["/mocap/lab/analog"]] == [1, 2]


def test_frames_that_wait_when_the_router_goes_are_counted(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1))
    lab.hear_all()
    may_go_on = stalled(lab)
    for number in range(3):
        publisher.publish(frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)])), stamp(), number, ALL)
    lab.cut()
    wait_until(lambda: not lab.is_connected())
    may_go_on.set()
    wait_until(lambda: lab.lost() == {"no router": 3})


def test_a_router_that_stops_reading_for_a_moment_loses_nothing() -> None:
    with ros_lab() as lab, stoppable_router(lab) as router:
        lab.open()
        publisher = lab.source(given=parameters(markers=10_000))
        wait_until(lambda: publisher.wants(ALL))
        router.send_signal(signal.SIGSTOP)
        large = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)] * 10_000))
        for number in range(_LARGE_FRAMES):
            publisher.publish(large, stamp(), number, ALL)
        time.sleep(0.3)  # the pause
        router.send_signal(signal.SIGCONT)
        assert router.stdout is not None
        assert router.stdout.readline().split() == [str(n + 1).encode() for n in range(_LARGE_FRAMES)]


_LARGE_FRAMES = 100
"""Clouds of 200 kB: more than the buffers of the connection hold."""

_ROUTER = """
import struct, sys, zenoh

with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    subscriber = session.declare_subscriber("0/mocap/lab/markers/**")
    for _ in range(int(sys.argv[2])):
        attachment = subscriber.recv().attachment.to_bytes()
        print(struct.unpack_from("<q", attachment)[0], end=" ")
    print(flush=True)
"""
"""A router that prints the numbers of the first clouds, and ends."""


@contextmanager
def stoppable_router(lab: RosLab) -> Iterator[subprocess.Popen[bytes]]:
    """Replace the lab's router by a process that subscribes to the markers."""
    lab.cut()
    keys = json.dumps(zenoh_keys("router", listen=lab.endpoint))
    command = [sys.executable, "-c", _ROUTER, keys, str(_LARGE_FRAMES)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_defect_is_logged_once_and_counted_and_the_next_frame_is_published(
    lab: RosLab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    publisher = lab.source(given=parameters(("wand",)))
    lab.hear_all()
    with monkeypatch.context() as patch:
        patch.setattr("gateway.outputs.ros2.source_topics.pack_pose", lambda *_values: 1 // 0)
        for _ in range(3):
            publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
        wait_until(lambda: lab.lost() == {"ZeroDivisionError": 3})
    publisher.publish(tools_frame((1, 2, 3)), stamp(), 1, ALL)
    wait_until(lambda: lab.received["/tf"])
    errors = [each.message for each in caplog.records if each.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "ZeroDivisionError" in errors[0]


def test_what_zenoh_refuses_is_counted_and_no_defect(
    lab: RosLab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_cdr: bytes, _now_ns: int) -> None:
        raise zenoh.ZError("no")

    publisher = lab.source(given=parameters(("wand",)))
    lab.hear_all()
    monkeypatch.setattr(lab.output._tf, "put", refuse)
    publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    wait_until(lambda: lab.lost() == {"put failed": 1})
    assert not [each for each in caplog.records if each.levelno >= logging.ERROR]
