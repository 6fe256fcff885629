"""Events on ROS 2: buttons, triggers and steps, each of them a diagnostic_msgs/DiagnosticArray."""

from typing import Any, Final

from gateway.messages.descriptions.labels import MAX_EVENT_AGE_US, event_text
from gateway.messages.ros2.encode import DiagnosticStatus, diagnostic_array, ros_stamp
from gateway.rtc3d.parameters import Parameters

_OK: Final = 0


def event_utime(capture_utime: int, timestamp_us: int, event_us: int) -> int:
    """Return when an event happened, in µs since the Unix epoch.

    ``capture_utime`` is the time of its frame. ``timestamp_us`` and ``event_us`` are the server's time stamps
    of the frame and of the event, which may be earlier or later (field note 6). If it is implausible, the
    event has the time of the frame.
    """
    delay_us = timestamp_us - event_us
    return capture_utime - delay_us if abs(delay_us) <= MAX_EVENT_AGE_US else capture_utime


def event_message(source: str, parameters: Parameters, event: Any, utime: int) -> bytes:
    """Return the message of an event, an item with the fields of SHORT_EVENT.

    Its only status has the label as name and all parameters as text. The values are the id, in decimal, and
    the parameters.
    """
    text = event_text(parameters, event)
    values = {"id": str(int(event["id"])), **dict(text.values)}
    status = DiagnosticStatus(_OK, text.label, text.description, source, values)
    return diagnostic_array(ros_stamp(utime), [status])
