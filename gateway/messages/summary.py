"""Summaries of messages, one line each, for people."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import rtc3d

from gateway.errors import ParametersError
from gateway.messages.source_report import LossReport, SourceReport, source_report
from gateway.messages.texts import xml_bytes
from gateway.rtc3d.components import POSE_FIELDS
from gateway.rtc3d.parameters import SECTIONS, Parameters
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.runtime.losses import counts_text

_MAX_SHOWN: Final = 4
"""The maximum number of channels, plates or events in a line."""


def summarise(message: Any, units: Sequence[str] = ()) -> str:
    """Return a line about a decoded LCM message, with what a person wants to see first.

    ``units`` are those of the items of a component, in their order; () if they are unknown.
    """
    match message:
        case rtc3d.status_t():
            text = _status(source_report(message))
        case rtc3d.clock_t():
            text = f"#{message.sequence} {_clock(message.clock)} ({message.components})"
        case rtc3d.parameters_t():
            version = f"session {message.session}, version {message.parameters_version}"
            text = f"#{message.sequence} {version}: {summarise_xml(xml_bytes(message.xml))}"
        case rtc3d.parameters_request_t():
            sections = " ".join(message.sections) or "all"
            fresh = ", fresh" if message.fresh else ""
            text = f"request {message.request_id} from {message.requester!r}: {sections}{fresh}"
        case rtc3d.parameters_reply_t():
            content = message.error or f"{summarise_xml(xml_bytes(message.xml))}, {message.age_s:.1f} s old"
            text = f"reply {message.request_id} to {message.requester!r}: {content}"
        case rtc3d.command_request_t():
            command = " ".join([message.command, *message.options])
            text = f"command {message.request_id} from {message.requester!r}: {command}"
        case rtc3d.command_reply_t():
            text = f"reply {message.request_id} to {message.requester!r}: {message.error or message.content}"
        case rtc3d.take_t() | rtc3d.take_details_t() | rtc3d.take_end_t():
            text = _description(message)
        case _:
            frame = f"#{message.sequence} frame {message.frame_number} at {message.timestamp / 1e6:.4f} s"
            text = f"{frame}: {_frame_content(message, units)}"
    return text


def _description(message: Any) -> str:
    match message:
        case rtc3d.take_t():
            return f"take {message.name!r} of {message.source}, recorded on {message.host}"
        case rtc3d.take_details_t():
            return f"details of {message.source}: {message.subject!r}, {message.session!r}, {message.note!r}"
    return f"end of {message.source}, {message.messages_lost} messages lost"


def summarise_xml(xml: bytes) -> str:
    """Return what a server's XML (§6) contains: its size and the number of markers, tools and so on."""
    size = f"{len(xml)} bytes of XML"
    try:
        parameters = parse_parameters(xml).parameters
    except ParametersError:
        return f"{size} that cannot be read as parameters"
    return f"{size}: {described_items(parameters) or 'no markers, tools, channels, plates or events'}"


def described_items(parameters: Parameters, event: str = "event") -> str:
    """Return what parameters describe, such as "24 markers, 1 tool"; ``event`` is the word for events."""
    nouns = {
        "3d": "marker",
        "6d": "tool",
        "analog": "analog channel",
        "force": "force plate",
        "events": event,
    }
    counts = [
        (len(SECTIONS[key].items_of(parameters)), noun)
        for key, noun in nouns.items()
        if SECTIONS[key].of(parameters) is not None
    ]
    return ", ".join(f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts)


def _frame_content(message: Any, units: Sequence[str]) -> str:
    match message:
        case rtc3d.tool_pose_t(visible=False):
            text = "out of view"
        case rtc3d.tool_pose_t():
            position, orientation = _rounded(message.position_m), _rounded(message.orientation_xyzw)
            text = f"position {position} m, orientation xyzw {orientation}"
        case rtc3d.markers_t():
            text = f"{message.num_markers} markers, {_visibility(message.markers, units)}"
        case rtc3d.tools_t():
            text = f"{message.num_tools} tools, {_visibility(message.tools, units)}"
        case rtc3d.analog_t():
            voltages = _first(message.voltages, _number, ", ", units)
            text = f"{message.num_channels} channels, voltages {voltages}"
        case rtc3d.forces_t():
            forces = [(plate.fx, plate.fy, plate.fz) for plate in message.plates]
            text = f"{message.num_plates} plates, forces {_first(forces, _vector, '; ', units)}"
        case _:
            events = [
                f"id {each.id:#x} ({each.param1}, {each.param2}, {each.param3})" for each in message.events
            ]
            text = f"{message.num_events} events: {_first(events, str, '; ')}"
    return text


def _visibility(items: Sequence[Any], units: Sequence[str]) -> str:
    visible = [(item.x, item.y, item.z) for item in items if _is_visible(item)]
    first = f", first visible at {_with_unit(_rounded(visible[0]), units[:1])}" if visible else ""
    return f"{len(items) - len(visible)} missing{first}"


def _is_visible(item: Any) -> bool:
    """``rtc3d.components.is_visible`` for one item of a decoded message."""
    return all(math.isfinite(getattr(item, name, 0.0)) for name in POSE_FIELDS)


def _first(
    items: Sequence[Any], text: Callable[[Any], str], separator: str, units: Sequence[str] = ()
) -> str:
    """Return the first _MAX_SHOWN items as text, and "…" if there are more.

    A unit that all items share stands at the end, others after each item.
    """
    texts = [text(item) for item in items[:_MAX_SHOWN]]
    is_shared = len(set(units)) == 1
    if not is_shared:
        texts = [_with_unit(each, units[number : number + 1]) for number, each in enumerate(texts)]
    if len(items) > _MAX_SHOWN:
        texts.append("…")
    return _with_unit(separator.join(texts), units[:1] if is_shared else ())


def _with_unit(text: str, unit: Sequence[str]) -> str:
    return " ".join([text, *filter(None, unit)])


def _vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(map(_number, values)) + ")"


def _rounded(values: Sequence[float]) -> str:
    """Return positions or a quaternion without what is only a rounding error, such as 1.6e-17 for 0."""
    return _vector([round(value, 6) + 0.0 for value in values])  # + 0.0: no -0


def _number(value: float) -> str:
    """Return a number with four digits, and all digits before the point."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def _clock(clock: Any) -> str:
    if not clock.has_clock:
        return "the server's time stamps cannot be used as a clock"
    return f"offset {clock.offset_us} µs, drift {clock.drift_ppm:.1f} ppm, ± {clock.uncertainty_us:.0f} µs"


def _status(report: SourceReport) -> str:
    streams = "; ".join(
        f"[{stream.components}] {stream.state} {stream.frame_rate_hz:.1f} Hz, {stream.num_frames} frames, "
        f"{stream.num_reconnects} reconnects{_lost(stream.losses)}"
        f"{stream.last_error and f', last error: {stream.last_error}'}"
        for stream in report.streams
    )
    outputs = "; ".join(
        f"{output.output} {'ok' if output.is_connected else output.problem}{_lost(output.losses)}"
        for output in report.outputs
    )
    return f"#{report.sequence} {report.name} at {report.server}: {streams}; outputs: {outputs}"


def _lost(losses: Sequence[LossReport]) -> str:
    """Return what was lost, such as ", lost 872 messages of 436 frames (skipped while behind)"."""
    return f", lost {counts_text(losses)}" if losses else ""
