"""Checks of the frames that one stream received: complete, in time, in which byte order, what is visible."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from gateway.outputs.findings import Check, Finding
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType, described_labels, described_rate_hz, num_described_items
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.quantities import rate_text
from gateway.session.state import StreamState
from gateway.session.status import FRAME_REJECTED
from gateway.tools.doctor.observation import COMPONENTS_WITH_VISIBILITY, ObservedStream

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
    texts = [  # such as "3d 100 of 200"
        f"{component.key} {rate_text(hz)}"
        + (f" of {rate_text(expected_hz[component])}" if component in expected_hz else "")
        for component, hz in rates_hz.items()
    ]
    found = f"{', '.join(texts)} Hz"
    compared = [component for component in rates_hz if component in expected_hz]
    if not compared and isinstance(stream.settings.rate, FrequencyDivisor):
        return check.note(
            f"{found}; the server announces no rate, so the configured divisor "
            f"{stream.settings.rate.divisor} cannot be compared"
        )
    if not compared:
        return check.not_tested(f"{found}; the server's parameters have no rate to compare with")
    slow = [component for component in compared if rates_hz[component] < _MIN_SHARE * expected_hz[component]]
    if slow:
        return _too_slow(check, stream, found, slow, rates_hz, expected_hz)
    if all(rates_hz[component] <= _MAX_SHARE * expected_hz[component] for component in compared):
        return check.passing(found)
    problem = "the server ignores the requested rate"
    remedy = (
        "Lower the rate on the server, or limit what the gateway publishes with max_rate_hz of the outputs."
    )
    if isinstance(stream.settings.rate, AllFrames):
        problem = "the server sends more frames than its parameters announce"
        remedy = (
            "Correct the rate in the server's settings. Programs that rely on the announced rate compute "
            "wrong times, and the load on the network is higher than expected."
        )
    return check.failing(f"{found}: {problem}", remedy)


def _too_slow(
    check: Check,
    stream: ObservedStream,
    found: str,
    slow: Sequence[ComponentType],
    rates_hz: _Rates,
    expected_hz: _Rates,
) -> Finding:
    others_hz = [expected_hz[other] for other in rates_hz if other in expected_hz and other not in slow]
    # The slow components may arrive at the rate of the stream's slowest component (§5.3.5).
    is_limited_by_others = bool(others_hz) and all(
        _MIN_SHARE * min(others_hz) <= rates_hz[component] <= min(others_hz) / _MIN_SHARE
        for component in slow
    )
    names = " and ".join(component.key for component in slow)
    if not is_limited_by_others:
        return check.failing(
            found,
            "The server or the network is too slow. Check the server's real-time processing rate and load, "
            "the cable and the switch, or configure a lower rate for the stream.",
        )
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

START: Final = "Start a measurement on the server; the gateway then streams automatically."


def check_frames(
    check: Check, stream: ObservedStream, parameters: Parameters | None, *, others_receive: bool
) -> Finding:
    """Check that well-formed frames arrive until the end, with every component that the stream requested.

    ``others_receive`` says whether another stream of the source has received frames.
    """
    is_partial = len(stream.settings.components) < len(ComponentType)
    of_stream = f" of stream {stream.component_keys}" if is_partial else ""
    num_frames = stream.status.frames_in
    if not stream.session.is_open:
        return check.failing(
            f"the server closed the connection{of_stream} while the doctor waited for frames",
            "Check whether another program takes over the stream, and read the server's own messages.",
        )
    if rejected := stream.status.losses.frames(FRAME_REJECTED):
        return check.failing(
            f"{rejected} of {rejected + num_frames} frames{of_stream} are malformed: "
            f"{stream.status.last_error.removeprefix('frame rejected: ')}",
            "The gateway drops malformed frames. Update the server's software, or report this to its maker.",
        )
    items_of = [  # the components that the parameters describe but no frame contains
        component.key
        for component in stream.settings.components
        if parameters and component not in stream.observed and num_described_items(parameters, component)
    ]
    missing = ", ".join(items_of)
    if not stream.observed:
        return _no_frames(check, stream, of_stream, missing, others_receive=others_receive)
    if stopped := _stopped(check, stream, of_stream):
        return stopped
    names = ", ".join(each.key for each in stream.settings.components if each in stream.observed)
    largest = max(component.message_load.largest_bytes for component in stream.observed.values())
    received = f"{num_frames} frames with {names}; the largest message has {largest} bytes"
    absent = f"the server's parameters list items of {missing}, but no frame contains {missing}"
    if missing and not stream.requests_all:
        return check.failing(
            absent,
            f"Enable the real-time output of {missing} on the server, or remove {missing} from the stream's "
            "components.",
        )
    return check.note(f"{received}; {absent}", _enable(missing)) if missing else check.passing(received)


def _enable(components: str) -> str:
    return f"If you need {components}, enable its real-time output on the server."


def _stopped(check: Check, stream: ObservedStream, of_stream: str) -> Finding | None:
    """Return a finding if no frame has come for longer than usual. Events do not count: they are rare."""
    rates_hz = [
        observed.rate_hz
        for component, observed in stream.observed.items()
        if component is not ComponentType.EVENT
    ]
    if not rates_hz:
        return None
    found = (
        f"the server stopped sending after {stream.status.frames_in} frames{of_stream}: none arrived for "
        f"{stream.silence_s:.1f} s, and the server"
    )
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return check.failing(f"{found} reports that no measurement is running", START)
    usual_s = _MAX_SILENT_FRAMES / max(rates_hz) if max(rates_hz) else 0.0
    if stream.silence_s <= max(_MAX_SILENCE_S, usual_s):
        return None
    return check.failing(
        f"{found} did not report that no measurement is running",
        "Check whether the server's own display has stopped, too, and its load; then the cable and the "
        "switch. A longer watch with --seconds shows whether frames come again.",
    )


def _no_frames(
    check: Check, stream: ObservedStream, of_stream: str, missing: str, *, others_receive: bool
) -> Finding:
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return check.failing("the server reports that no measurement is running", START)
    if stream.settings.components == (ComponentType.EVENT,):
        return check.not_tested("no event occurred during the check")
    if stream.requests_all and others_receive:
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
    shares: list[float] = []
    texts: list[str] = []
    for component in COMPONENTS_WITH_VISIBILITY:
        observed = stream.observed.get(component)
        if observed is None or (share := observed.visible_share) is None:
            continue
        shares.append(share)
        never = ""
        if share and (indices := observed.never_visible_indices):
            labels = described_labels(parameters, component) if parameters else []
            names = [
                (labels[index] if index < len(labels) else "") or f"number {index + 1}" for index in indices
            ]
            more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
            never = f" (never {', '.join(names[:_MAX_NAMES])}{more})"
        texts.append(f"{component.item_noun} {share:.0%}{never}")
    if not shares:
        return check.not_tested("no markers or tools arrived")
    found = f"in view: {', '.join(texts)}"
    if min(shares) >= _MIN_VISIBLE:
        return check.passing(found)
    return check.failing(
        found,
        "Check that the cameras see the volume, that the markers are inside it and not covered, and that the "
        "strobers are on and charged.",
    )


_TCP_RMEM: Final = Path("/proc/sys/net/ipv4/tcp_rmem")
_STOP_S: Final = 2.0
_PAYLOAD_SHARE: Final = 0.5
"""The part of a receive buffer that data can use. The kernel needs the rest to manage packets."""


def check_receive_buffer(check: Check, load_bytes_per_s: float, tcp_rmem: Path = _TCP_RMEM) -> Finding:
    """Check that one connection's receive buffer can hold what arrives in 2 s.

    ``tcp_rmem`` has the smallest, the initial and the largest size of a receive buffer, in bytes. The gateway
    has the kernel provide the largest one (gateway/session/tcp.py).
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
        return check.passing(f"the kernel holds what the server sends in {min(holds_s, 60):.0f} s ({load})")
    mebibyte = 1 << 20
    needed = (int(load_bytes_per_s * _STOP_S / _PAYLOAD_SHARE) // mebibyte + 1) * mebibyte
    return check.failing(
        f"the kernel holds only what the server sends in {holds_s:.1f} s ({load}); "
        "if the gateway stops for longer, frames may be lost",
        f'Run sysctl -w net.ipv4.tcp_rmem="{smallest} {initial} {needed}", and put '
        f"net.ipv4.tcp_rmem = {smallest} {initial} {needed} into /etc/sysctl.d/90-rtc3d.conf to keep it.",
    )
