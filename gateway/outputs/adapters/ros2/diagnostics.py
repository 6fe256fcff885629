"""The status of a source as diagnostics of ROS 2, as rqt_robot_monitor and ``ros2 topic echo`` show them."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import zenoh

from gateway.errors import OutputError, raise_unless_defect
from gateway.messages.decode import decode
from gateway.messages.ros2.encode import DiagnosticStatus, diagnostic_array, ros_stamp
from gateway.messages.source_report import LossReport, OutputReport, SourceReport, StreamReport, source_report
from gateway.outputs.adapters.ros2.source import Sender
from gateway.outputs.adapters.ros2.topic import RosTopic
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.session import SessionHolder
from gateway.runtime.failures import DefectLog

OK: Final = 0
WARN: Final = 1
ERROR: Final = 2

_LEVELS: Final = {"streaming": OK, "idle": OK, "no measurement": WARN}
"""By the state of a stream; all other states are errors."""

_MAX_LABEL_CHARS: Final = 100
"""How much of a label is published each second."""

Names = Mapping[str, Mapping[str, str]]
"""Names in topics, by the component's key and by label."""

NO_NAMES: Final[Names] = {}

_MAX_PREVIOUS_US: Final = 3_000_000
"""The greatest age of a previous status. There is one each second, while somebody subscribes."""

logger = logging.getLogger(__name__)


class DiagnosticsPublisher:
    """Publishes each ``status_t`` of a source on /diagnostics.

    ``names`` returns what ``Output.topic_names`` does. The sending thread calls it.
    """

    def __init__(
        self, topic: RosTopic, names: Callable[[], Names], router: SessionHolder, sender: Sender
    ) -> None:
        self._topic = topic
        self._names = names
        self._router = router
        self._sender = sender
        self._defects = DefectLog(logger, "ros2 diagnostics")
        self._previous: SourceReport | None = None  # only in the sending thread
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes to the diagnostics."""
        return self._topic.wanted and not self._is_closed

    def publish(self, message: bytes) -> None:
        """Queue a status for the sending thread. Raises OutputError if it cannot be sent."""
        if self._is_closed:
            raise OutputError("the diagnostics of this source are closed", cause="closed")
        if self._router.is_cut_off:
            raise self._router.refusal
        if self.wanted and not self._sender.offer(lambda: self._send(message), len(message)):
            text = "too many messages wait for the Zenoh router; check it and the network to it"
            raise OutputError(text, cause="queue full")

    def _send(self, message: bytes) -> None:
        try:
            previous, self._previous = self._previous, source_report(decode(message))
            statuses = diagnostics_of(self._previous, previous, self._names())
            self._topic.put(diagnostic_array(ros_stamp(self._previous.utime), statuses), time.time_ns())
        except zenoh.ZError as error:
            logger.debug("ros2: publishing diagnostics: %s", zenoh_reason(error))
        except BaseException as defect:  # noqa: BLE001 - the sending thread continues
            raise_unless_defect(defect)
            self._defects.log(defect)

    def close(self) -> None:
        """Refuse further messages."""
        self._is_closed = True


def diagnostics_of(
    report: SourceReport, previous: SourceReport | None = None, names: Names = NO_NAMES
) -> list[DiagnosticStatus]:
    """Return the report of a source: one status per stream and output, and one of the coordinate frame.

    There is one more for items whose topics have other ``names`` than their labels.

    A stream or output that has lost messages since ``previous``, the report before, gets a warning. If
    that is missing or old, it is unknown when they were lost.
    """
    name = f"rtc3d_gateway: {report.name}"
    lost: Mapping[str, int] = {}
    if previous is not None and report.utime - previous.utime <= _MAX_PREVIOUS_US:
        lost = _lost(previous)
    return [
        *(_stream(name, report.server, stream, lost) for stream in report.streams),
        *(_output(name, report.server, output, lost) for output in report.outputs),
        _frame(name, report),
        *([_labels(name, report.server, names)] if any(names.values()) else ()),
    ]


def _frame(name: str, report: SourceReport) -> DiagnosticStatus:
    """Return how the source's positions were made from the server's, for nodes that need those."""
    values = {
        "metres per unit of the server": f"{report.metres_per_unit:g}",
        "rotation (x y z w)": " ".join(map(repr, report.rotation_xyzw)),
        "translation (m)": " ".join(map(repr, report.translation_m)),
    }
    level, message = OK, report.frame_id
    if not report.metres_per_unit:
        level, message = WARN, f"{report.frame_id}: the server's unit of length is unknown"
    return DiagnosticStatus(level, f"{name} coordinate frame", message, report.server, values)


def _labels(name: str, server: str, names: Names) -> DiagnosticStatus:
    """Return the names in topics by component and label, for nodes that look for a label."""
    values = {
        f"{component} {label[:_MAX_LABEL_CHARS]}": part
        for component, parts in names.items()
        for label, part in parts.items()
    }
    return DiagnosticStatus(OK, f"{name} names", "labels that are not valid names in ROS", server, values)


def _stream(name: str, server: str, stream: StreamReport, lost: Mapping[str, int]) -> DiagnosticStatus:
    level = _LEVELS.get(stream.state, ERROR)
    message = stream.state
    if level == ERROR and stream.last_error:
        message += f": {stream.last_error}"
    if level == OK and stream.problem:
        level, message = ERROR, stream.problem
    num_lost = _num_lost(stream.losses)
    if level == OK:
        level, message = _with_losses(message, num_lost - lost.get(stream.components, num_lost))
    values = {
        "rate (Hz)": f"{stream.frame_rate_hz:.1f}",
        "lag (ms)": f"{stream.lag_ms:.1f}",
        "frames": str(stream.num_frames),
        "reconnects": str(stream.num_reconnects),
        "session": str(stream.session),
        "messages lost": str(num_lost),
        **_causes(stream.losses),
        **{f"limitation {number}": text for number, text in enumerate(stream.limitations, start=1)},
    }
    return DiagnosticStatus(level, f"{name} {stream.components}", message, server, values)


def _output(name: str, server: str, output: OutputReport, lost: Mapping[str, int]) -> DiagnosticStatus:
    values = {f"sent {component}": str(number) for component, number in output.messages.items()}
    values |= _causes(output.losses)
    level, message = ERROR, output.problem
    if output.is_connected:
        num_lost = _num_lost(output.losses)
        level, message = _with_losses("connected", num_lost - lost.get(f"to {output.output}", num_lost))
    return DiagnosticStatus(level, f"{name} to {output.output}", message, server, values)


def _with_losses(message: str, num_new: int) -> tuple[int, str]:
    return (WARN, f"{message}; messages lost: {num_new}") if num_new > 0 else (OK, message)


def _lost(report: SourceReport) -> dict[str, int]:
    """Return how many messages a report says were lost, by stream and output."""
    streams = {stream.components: _num_lost(stream.losses) for stream in report.streams}
    return streams | {f"to {output.output}": _num_lost(output.losses) for output in report.outputs}


def _num_lost(losses: Sequence[LossReport]) -> int:
    return sum(loss.num_messages for loss in losses)


def _causes(losses: Sequence[LossReport]) -> dict[str, str]:
    return {f"lost: {loss.cause}": str(loss.num_messages) for loss in losses}
