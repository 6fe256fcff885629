"""Check of the rate at which one stream's components arrive."""

from collections.abc import Mapping, Sequence
from typing import Final

from gateway.doctor.observation import ObservedStream
from gateway.findings import Finding, Subject
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.server_description import described_rate_hz
from gateway.stream.plan import rate_text

_MIN_SHARE: Final = 0.9
_MAX_SHARE: Final = 1.1
"""The check fails if a component arrives at a smaller or a larger share of its expected rate."""

_Rates = Mapping[ComponentType, float]
"""Rates in Hz."""


def check_rate(subject: Subject, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    """Check that each component arrives at the rate that the server announces, or the one configured."""
    rates_hz: _Rates = {
        component: observed.rate_hz
        for component, observed in stream.observed.items()
        if component is not ComponentType.EVENT and observed.rate_hz > 0
    }
    if not rates_hz:
        return subject.not_tested("rate", "too few frames to measure the rate")
    expected_hz = _expected_rates_hz(stream, parameters)
    found = f"{', '.join(_rate_text(component, rates_hz, expected_hz) for component in rates_hz)} Hz"
    compared = [component for component in rates_hz if component in expected_hz]
    if not compared and isinstance(stream.settings.rate, FrequencyDivisor):
        return subject.note(
            "rate",
            f"{found}; the server announces no rate, so the configured divisor "
            f"{stream.settings.rate.divisor} cannot be compared",
        )
    if not compared:
        return subject.not_tested("rate", f"{found}; the server's parameters have no rate to compare with")
    slow = [component for component in compared if rates_hz[component] < _MIN_SHARE * expected_hz[component]]
    if not slow:
        is_fast = any(rates_hz[component] > _MAX_SHARE * expected_hz[component] for component in compared)
        return _too_fast(subject, stream, found) if is_fast else subject.passing("rate", found)
    if _is_limited_by_others(slow, rates_hz, expected_hz):
        return _limited_by_others(subject, stream, found, slow)
    return subject.failing(
        "rate",
        found,
        "The server or the network is too slow. Check the server's real-time processing rate and load, the "
        "cable and the switch, or configure a lower rate for the stream.",
    )


def _limited_by_others(
    subject: Subject, stream: ObservedStream, found: str, slow: Sequence[ComponentType]
) -> Finding:
    names = " and ".join(component.key for component in slow)
    if stream.shares_connection:
        return subject.warning(
            "rate",
            f"{found}, because the server accepts one connection only",
            f"If the full rate of {names} matters more than the other components, request nothing else: "
            f"streams: [{{components: [{', '.join(component.key for component in slow)}]}}].",
        )
    return subject.failing(
        "rate",
        found,
        f"A stream is as fast as its slowest component. Move {names} to a stream of their own, or "
        "configure a lower rate for this stream.",
    )


def _too_fast(subject: Subject, stream: ObservedStream, found: str) -> Finding:
    if isinstance(stream.settings.rate, AllFrames):
        return subject.failing(
            "rate",
            f"{found}: the server sends more frames than its parameters announce",
            "Correct the rate in the server's settings. Programs that rely on the announced rate compute "
            "wrong times, and the load on the network is higher than expected.",
        )
    return subject.failing(
        "rate",
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
