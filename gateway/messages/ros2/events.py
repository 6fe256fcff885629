"""Events on ROS 2: buttons, triggers and steps, each of them a diagnostic_msgs/DiagnosticArray."""

from typing import Any, Final

from gateway.messages.descriptions.labels import event_text
from gateway.messages.ros2.encode import DiagnosticStatus, diagnostic_array, ros_stamp
from gateway.rtc3d.parameters import Parameters

_OK: Final = 0


def event_message(source: str, parameters: Parameters, event: Any, utime: int) -> bytes:
    """Return the message of an event, an item with the fields of SHORT_EVENT.

    Its only status has the label as name and all parameters as text. The values are the id, in decimal, and
    the parameters.
    """
    text = event_text(parameters, event)
    values = {"id": str(int(event["id"])), **dict(text.values)}
    status = DiagnosticStatus(_OK, text.label, text.description, source, values)
    return diagnostic_array(ros_stamp(utime), [status])
