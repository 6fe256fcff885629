"""Checks of the frames that one stream received: complete, in time, in which byte order, what is visible."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from gateway.doctor.observation import COMPONENTS_WITH_VISIBILITY, ObservedComponent, ObservedStream
from gateway.outputs.findings import Check, Finding
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType, described_labels, described_rate_hz, num_described_items
from gateway.rtc3d.parameters import Parameters
from gateway.stream.plan import rate_text
from gateway.stream.state import StreamState
from gateway.stream.status import FRAME_REJECTED

_MIN_SHARE: Final = 0.9
_MAX_SHARE: Final = 1.1
"""The check fails if a component arrives at a smaller or a larger share of its expected rate."""

_Rates = Mapping[ComponentType, float]
"""Rates in Hz."""


def check_rate(check: Check, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    """Check that each component arrives at the rate that the server announces, or the one configured."""
    rates_hz: _Rates = {
        component: observed.rate_hz
        for component, observed in stream.observed.items()
        if component is not ComponentType.EVENT and observed.rate_hz > 0
    }
    if not rates_hz:
        return check.not_tested("too few frames to measure the rate")
    expected_hz = _expected_rates_hz(stream, parameters)
    found = f"{', '.join(_rate_text(component, rates_hz, expected_hz) for component in rates_hz)} Hz"
    compared = [component for component in rates_hz if component in expected_hz]
    if not compared and isinstance(stream.settings.rate, FrequencyDivisor):
        return check.note(
            f"{found}; the server announces no rate, so the configured divisor "
            f"{stream.settings.rate.divisor} cannot be compared",
        )
    if not compared:
        return check.not_tested(f"{found}; the server's parameters have no rate to compare with")
    slow = [component for component in compared if rates_hz[component] < _MIN_SHARE * expected_hz[component]]
    if not slow:
        is_fast = any(rates_hz[component] > _MAX_SHARE * expected_hz[component] for component in compared)
        return _too_fast(check, stream, found) if is_fast else check.passing(found)
    if _is_limited_by_others(slow, rates_hz, expected_hz):
        return _limited_by_others(check, stream, found, slow)
    return check.failing(
        found,
        "The server or the network is too slow. Check the server's real-time processing rate and load, the "
        "cable and the switch, or configure a lower rate for the stream.",
    )


def _limited_by_others(
    check: Check, stream: ObservedStream, found: str, slow: Sequence[ComponentType]
) -> Finding:
    names = " and ".join(component.key for component in slow)
    if stream.shares_connection:
        return check.warning(
            f"{found}, because the server accepts one connection only",
            f"If the full rate of {names} matters more than the other components, request nothing else: "
            f"streams: [{{components: [{', '.join(component.key for component in slow)}]}}].",
        )
    return check.failing(
        found,
        f"A stream is as fast as its slowest component. Move {names} to a stream of their own, or "
        "configure a lower rate for this stream.",
    )


def _too_fast(check: Check, stream: ObservedStream, found: str) -> Finding:
    if isinstance(stream.settings.rate, AllFrames):
        return check.failing(
            f"{found}: the server sends more frames than its parameters announce",
            "Correct the rate in the server's settings. Programs that rely on the announced rate compute "
            "wrong times, and the load on the network is higher than expected.",
        )
    return check.failing(
        f"{found}: the server ignores the requested rate",
        "Lower the rate on the server, or limit what the gateway publishes with max_rate_hz of the outputs.",
    )


def _rate_text(component: ComponentType, rates_hz: _Rates, expected_hz: _Rates) -> str:
    """Return a component's measured and expected rate, such as "3d 100 of 200"."""
    expected = f" of {rate_text(expected_hz[component])}" if component in expected_hz else ""
    return f"{component.key} {rate_text(rates_hz[component])}{expected}"


def _is_limited_by_others(slow: Sequence[ComponentType], rates_hz: _Rates, expected_hz: _Rates) -> bool:
    """Return whether the slow components arrive at the rate of the stream's slowest component (§5.3.5)."""
    others_hz = [expected_hz[other] for other in rates_hz if other in expected_hz and other not in slow]
    return bool(others_hz) and all(
        _MIN_SHARE * min(others_hz) <= rates_hz[component] <= min(others_hz) / _MIN_SHARE
        for component in slow
    )


def _expected_rates_hz(stream: ObservedStream, parameters: Parameters | None) -> dict[ComponentType, float]:
    """Return the rate at which each component should arrive, for those with an announced or requested one.

    A divisor applies to the rate of the stream, which is that of its slowest component (§5.3.5).
    """
    rates_hz = {
        component: rate
        for component in stream.observed
        if parameters and (rate := described_rate_hz(parameters, component)) is not None
    }
    match stream.settings.rate:
        case Frequency(hz):
            return {component: min(rates_hz.get(component, hz), hz) for component in stream.observed}
        case FrequencyDivisor(divisor) if rates_hz:
            return {component: min(rates_hz.values()) / divisor for component in rates_hz}
        case _:
            return rates_hz


_MAX_SILENCE_S: Final = 0.5
_MAX_SILENT_FRAMES: Final = 5
"""Frames have stopped if none has arrived for this long, and for the time of this number of frames."""

_MIN_VISIBLE: Final = 0.5
"""The check fails if a smaller share of the markers, or of the tools, is in view."""

_MAX_NAMES: Final = 5
"""How many markers or tools a finding names."""


_START: Final = "Start a measurement on the server; the gateway then streams automatically."


def check_frames(
    check: Check, stream: ObservedStream, parameters: Parameters | None, *, others_receive: bool
) -> Finding:
    """Check that well-formed frames arrive until the end, with every component that the stream requested.

    ``others_receive`` says whether another stream of the source has received frames.
    """
    is_partial = len(stream.settings.components) < len(ComponentType)
    of_stream = f" of stream {stream.component_keys}" if is_partial else ""
    if not stream.session.is_open:
        return check.failing(
            f"the server closed the connection{of_stream} while the doctor waited for frames",
            "Check whether another program takes over the stream, and read the server's own messages.",
        )
    if stream.status.losses.frames(FRAME_REJECTED):
        return _malformed_frames(check, stream, of_stream)
    if not stream.observed:
        return _no_frames(check, stream, of_stream, parameters, others_receive=others_receive)
    if _has_stopped(stream):
        return _stopped_frames(check, stream, of_stream)
    return _check_components(check, stream, parameters)


def _check_components(check: Check, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    names = ", ".join(
        component.key for component in stream.settings.components if component in stream.observed
    )
    largest = max(component.message_load.largest_bytes for component in stream.observed.values())
    received = f"{stream.status.frames_in} frames with {names}; the largest message has {largest} bytes"
    missing = ", ".join(_missing_components(stream, parameters))
    if not missing:
        return check.passing(received)
    absent = f"the server's parameters list items of {missing}, but no frame contains {missing}"
    if stream.requests_all:
        return check.note(f"{received}; {absent}", _enable(missing))
    return check.failing(
        absent,
        f"Enable the real-time output of {missing} on the server, or remove {missing} from the stream's "
        "components.",
    )


def _has_stopped(stream: ObservedStream) -> bool:
    """Return whether no frame has come for longer than usual. Events do not count, because they are rare."""
    rates_hz = [
        observed.rate_hz
        for component, observed in stream.observed.items()
        if component is not ComponentType.EVENT
    ]
    if not rates_hz:
        return False
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return True
    rate_hz = max(rates_hz)
    usual_s = _MAX_SILENT_FRAMES / rate_hz if rate_hz else 0.0
    return stream.silence_s > max(_MAX_SILENCE_S, usual_s)


def _stopped_frames(check: Check, stream: ObservedStream, of_stream: str) -> Finding:
    found = (
        f"the server stopped sending after {stream.status.frames_in} frames{of_stream}: none arrived for "
        f"{stream.silence_s:.1f} s, and the server"
    )
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return check.failing(f"{found} reports that no measurement is running", _START)
    return check.failing(
        f"{found} did not report that no measurement is running",
        "Check whether the server's own display has stopped, too, and its load; then the cable and the "
        "switch. A longer watch with --seconds shows whether frames come again.",
    )


def _enable(components: str) -> str:
    return f"If you need {components}, enable its real-time output on the server."


def _malformed_frames(check: Check, stream: ObservedStream, of_stream: str) -> Finding:
    rejected = stream.status.losses.frames(FRAME_REJECTED)
    return check.failing(
        f"{rejected} of {rejected + stream.status.frames_in} frames{of_stream} are malformed: "
        f"{stream.status.last_error.removeprefix('frame rejected: ')}",
        "The gateway drops malformed frames. Update the server's software, or report this to its maker.",
    )


def _missing_components(stream: ObservedStream, parameters: Parameters | None) -> list[str]:
    """Return the keys of the components that the parameters describe but no frame contains."""
    return [
        component.key
        for component in stream.settings.components
        if parameters and component not in stream.observed and num_described_items(parameters, component)
    ]


def _no_frames(
    check: Check,
    stream: ObservedStream,
    of_stream: str,
    parameters: Parameters | None,
    *,
    others_receive: bool,
) -> Finding:
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return check.failing(
            "the server reports that no measurement is running",
            _START,
        )
    if stream.settings.components == (ComponentType.EVENT,):
        return check.not_tested("no event occurred during the check")
    if stream.requests_all and others_receive:
        missing = ", ".join(_missing_components(stream, parameters))
        return check.note(
            f"the server's parameters list items of {missing}, but no frame{of_stream} arrived",
            _enable(missing),
        )
    if stream.status.frames_in:
        return check.failing(
            f"{stream.status.frames_in} frames arrived, but none has a component{of_stream or ' with data'}",
            "Check the server's real-time output, and the components in the source's streams.",
        )
    return check.failing(
        f"no frame{of_stream} arrived, and the server did not report that no measurement is running",
        "Check that the server shows live data and that its real-time output is enabled. Try other "
        "components in the stream, or watch longer with --seconds.",
    )


def check_byte_order(check: Check, stream: ObservedStream, requested: str) -> Finding:
    """Check that the frames have the byte order that was ``requested`` (field note 4)."""
    byte_order = stream.session.byte_order
    if not byte_order:
        return check.not_tested("no frames arrived")
    if byte_order == requested:
        return check.passing(f"the frames are {byte_order}-endian, as requested")
    return check.warning(
        f"the server sends {byte_order}-endian frames, although the gateway requests {requested}-endian ones",
        "The gateway reads the frames as they are, and publishes the same messages. To request what the "
        f"server sends, set byte_order: {byte_order} for this source.",
    )


def check_visibility(check: Check, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    """Check that at least half of the markers and half of the tools are in view."""
    shares = {
        component: share
        for component in COMPONENTS_WITH_VISIBILITY
        if component in stream.observed and (share := stream.observed[component].visible_share) is not None
    }
    if not shares:
        return check.not_tested("no markers or tools arrived")
    texts = ", ".join(
        f"{component.item_noun} {share:.0%}"
        f"{_never_visible(stream.observed[component], component, parameters)}"
        for component, share in shares.items()
    )
    found = f"in view: {texts}"
    if min(shares.values()) >= _MIN_VISIBLE:
        return check.passing(found)
    return check.failing(
        found,
        "Check that the cameras see the volume, that the markers are inside it and not covered, and that the "
        "strobers are on and charged.",
    )


def _never_visible(
    observed: ObservedComponent, component: ComponentType, parameters: Parameters | None
) -> str:
    """Return " (never NAMES)" for the items that were never in view; "" if these are all items or none."""
    indices = observed.never_visible_indices
    if not indices or not observed.visible_share:
        return ""
    labels = described_labels(parameters, component) if parameters else []
    names = [(labels[index] if index < len(labels) else "") or f"number {index + 1}" for index in indices]
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f" (never {', '.join(names[:_MAX_NAMES])}{more})"


_TCP_RMEM: Final = Path("/proc/sys/net/ipv4/tcp_rmem")
_STOP_S: Final = 2.0
_PAYLOAD_SHARE: Final = 0.5
"""The part of a receive buffer that data can use. The kernel needs the rest to manage packets."""


def check_receive_buffer(check: Check, load_bytes_per_s: float, tcp_rmem: Path = _TCP_RMEM) -> Finding:
    """Check that one connection's receive buffer can hold what arrives in 2 s.

    ``tcp_rmem`` has the smallest, the initial and the largest size of a receive buffer, in bytes. The gateway
    has the kernel provide the largest one (gateway/stream/tcp.py).
    """
    if not load_bytes_per_s:
        return check.not_tested("no frames arrived")
    try:
        smallest, initial, largest = map(int, tcp_rmem.read_text("ascii").split())
    except (OSError, ValueError) as error:
        return check.not_tested(f"{tcp_rmem} cannot be read: {error}")
    holds_s = largest * _PAYLOAD_SHARE / load_bytes_per_s
    load = f"{load_bytes_per_s / 1e6:.2g} MB/s"
    if holds_s >= _STOP_S:
        text = f"the kernel holds what the server sends in {min(holds_s, 60):.0f} s ({load})"
        return check.passing(text)
    needed = _next_mebibyte(load_bytes_per_s * _STOP_S / _PAYLOAD_SHARE)
    return check.failing(
        f"the kernel holds only what the server sends in {holds_s:.1f} s ({load}); "
        "if the gateway stops for longer, frames may be lost",
        f'Run sysctl -w net.ipv4.tcp_rmem="{smallest} {initial} {needed}", and put '
        f"net.ipv4.tcp_rmem = {smallest} {initial} {needed} into /etc/sysctl.d/90-rtc3d.conf to keep it.",
    )


def _next_mebibyte(size: float) -> int:
    mebibyte = 1 << 20
    return (int(size) // mebibyte + 1) * mebibyte
