"""Messages for people: any of our LCM messages as an object, as JSON values, as one line of text."""

import math
from collections.abc import Sequence
from typing import Any, Final

import rtc3d

from gateway.errors import ParametersError, ProtocolError
from gateway.rtc3d.parameters_xml import parse_parameters

MESSAGE_TYPES_BY_NAME: Final[dict[str, type[Any]]] = {
    message_type.__name__: message_type
    for message_type in (
        rtc3d.markers_t,
        rtc3d.tools_t,
        rtc3d.analog_t,
        rtc3d.forces_t,
        rtc3d.events_t,
        rtc3d.tool_pose_t,
        rtc3d.status_t,
        rtc3d.clock_t,
        rtc3d.parameters_t,
        rtc3d.parameters_request_t,
        rtc3d.parameters_reply_t,
    )
}
"""The types of all messages that go out, and of those that come back on LCM."""

_TYPES: Final = {
    message_type._get_packed_fingerprint(): message_type  # noqa: SLF001 - lcm-gen offers no other way
    for message_type in MESSAGE_TYPES_BY_NAME.values()
}


def message_type(message: bytes) -> type[Any]:
    """Return the message's LCM type, told by its fingerprint.

    Raises ProtocolError for bytes that are none of our messages.
    """
    found = _TYPES.get(message[:8])
    if found is None:
        raise ProtocolError(
            f"{len(message)} bytes with the fingerprint {message[:8].hex()} are no message of this gateway; "
            "is another program, or another version of the gateway, publishing here?"
        )
    return found


def decode(message: bytes) -> Any:
    """Return the message as the object of its LCM type; raises ProtocolError if it is none of ours."""
    kind = message_type(message)
    try:
        decoded = kind.decode(message)
        # lcm-gen's decoders take a text that is cut short for a shorter one. Where there are texts, no
        # float is a signalling NaN, the one value that does not come back as it was.
        whole = decoded.encode() == message or "string" not in kind.__typenames__
    except Exception as error:  # lcm-gen's decoders raise whatever comes
        raise ProtocolError(f"a {kind.__name__} of {len(message)} bytes is cut short") from error
    if not whole:
        raise ProtocolError(f"a {kind.__name__} of {len(message)} bytes is cut short or too long")
    return decoded


def to_json(value: Any) -> Any:
    """Return an LCM object, or a list or value in it, as what ``json`` can write; NaN becomes None."""
    if hasattr(value, "__slots__"):
        return {name: to_json(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def one_line(message: Any) -> str:
    """Return what a person wants to see first of a decoded message."""
    if isinstance(message, rtc3d.status_t):
        return _status_line(message)
    if isinstance(message, rtc3d.clock_t):
        return f"#{message.sequence} {_clock_text(message.clock)} ({message.components})"
    if isinstance(message, rtc3d.parameters_t | rtc3d.parameters_request_t | rtc3d.parameters_reply_t):
        return _parameters_line(message)
    text = _contents(message)
    return f"#{message.sequence} frame {message.frame_number} at {message.timestamp / 1e6:.4f} s: {text}"


def _contents(message: Any) -> str:
    match message:
        case rtc3d.tool_pose_t(visible=False):
            text = "out of view"
        case rtc3d.tool_pose_t():
            position, orientation = _numbers(message.position_m), _numbers(message.orientation_xyzw)
            text = f"position {position} m, orientation xyzw {orientation}"
        case rtc3d.markers_t():
            text = f"{message.num_markers} markers, {_positions(message.markers)}"
        case rtc3d.tools_t():
            text = f"{message.num_tools} tools, {_positions(message.tools)}"
        case rtc3d.analog_t():
            text = f"{message.num_channels} channels, {_numbers(message.voltages[:4])} …"
        case rtc3d.forces_t():
            loads = "; ".join(_numbers((plate.fx, plate.fy, plate.fz)) for plate in message.plates[:4])
            text = f"{message.num_plates} plates, forces {loads}"
        case _:
            events = "; ".join(
                f"id {event.id:#x} ({event.param1}, {event.param2}, {event.param3})"
                for event in message.events[:4]
            )
            text = f"{message.num_events} events: {events}"
    return text


def _positions(items: Sequence[Any]) -> str:
    seen = [(item.x, item.y, item.z) for item in items if not math.isnan(item.x)]
    first = f", the first seen at {_numbers(seen[0])}" if seen else ""
    return f"{len(items) - len(seen)} missing{first}"


def _clock_text(clock: Any) -> str:
    if not clock.has_clock:
        return "the server's time stamps make no clock"
    return f"offset {clock.offset_us} µs, drift {clock.drift_ppm:.1f} ppm, ± {clock.uncertainty_us:.0f} µs"


def _parameters_line(message: Any) -> str:
    match message:
        case rtc3d.parameters_t():
            return f"#{message.sequence} session {message.session}: {xml_text(message.xml.encode())}"
        case rtc3d.parameters_request_t():
            sections = " ".join(message.sections) or "all"
            fresh = ", fresh" if message.fresh else ""
            return f"request {message.request_id} of {message.requester!r}: {sections}{fresh}"
    reply = message.error or f"{xml_text(message.xml.encode())}, {message.age_s:.1f} s old"
    return f"reply {message.request_id} to {message.requester!r}: {reply}"


def xml_text(xml: bytes) -> str:
    """Return in a few words what a server's XML holds (§6)."""
    size = f"{len(xml)} bytes of XML"
    try:
        parameters = parse_parameters(xml).parameters
    except ParametersError:
        return f"{size} that cannot be read as parameters"
    items = (
        ("marker", parameters.markers, "markers"),
        ("tool", parameters.tools, "tools"),
        ("analog channel", parameters.analog, "channels"),
        ("force plate", parameters.force, "plates"),
        ("event", parameters.events, "events"),
    )
    counts = [(len(getattr(part, field)), name) for name, part, field in items if part is not None]
    held = [f"{count} {name}{'' if count == 1 else 's'}" for count, name in counts]
    return f"{size}: {', '.join(held) or 'no markers, tools, channels, plates or events'}"


def _numbers(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def _status_line(status: Any) -> str:
    streams = "; ".join(
        f"[{stream.components}] {stream.state} {stream.frame_rate_hz:.1f} Hz, {stream.frames_in} frames, "
        f"{stream.reconnects} reconnects"
        + (f", last error: {stream.last_error}" if stream.last_error else "")
        for stream in status.streams
    )
    outputs = "; ".join(
        f"{output.name} {'ok' if output.connected else output.problem}" for output in status.outputs
    )
    return f"#{status.sequence} {status.source} at {status.server}: {streams}; outputs: {outputs}"
