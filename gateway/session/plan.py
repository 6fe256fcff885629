"""What to request from a server: which components share a connection (§5.3.5), and at which rate."""

from collections.abc import Sequence
from operator import itemgetter
from typing import Final, NamedTuple

from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate, StreamFrames
from gateway.rtc3d.components import WIRE_ORDER, ComponentType, described_rate_hz, num_described_items
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.quantities import rate_text

_SAME_RATE: Final = 1.01
"""Rates within this factor are one rate: servers round the rates in their parameters."""

Components = tuple[ComponentType, ...]
"""Components in WIRE_ORDER."""


class StreamPlan(NamedTuple):
    """The connections that a server's components need.

    ``groups`` are the components of each connection; together they are all components. The first group is
    the slowest one. It also has the components without an announced rate and the events, which are sent
    with any frame. ``rates_hz`` are the announced rates of the groups, () if the server announces none.
    ``limitation`` says what the plan costs and why; "" if it costs nothing.
    """

    groups: tuple[Components, ...] = (WIRE_ORDER,)
    rates_hz: tuple[float, ...] = ()
    limitation: str = ""

    def on_one_connection(self, reason: str) -> "StreamPlan":
        """Return the plan with one connection for all components, because of ``reason``."""
        slowest_hz = rate_text(self.rates_hz[0])
        faster = zip(self.groups[1:], self.rates_hz[1:], strict=True)
        (first, first_hz), *others = ((keys_text(group), rate_text(rate_hz)) for group, rate_hz in faster)
        announced = ", ".join([f"{first_hz} Hz", *(f"{keys} instead of {hz} Hz" for keys, hz in others)])
        verb = "arrives" if len(self.groups[1]) == 1 else "arrive"
        return StreamPlan(
            (WIRE_ORDER,),
            self.rates_hz[:1],
            f"{first} {verb} at {slowest_hz} Hz instead of {announced}: {reason}",
        )


def announced_rates_hz(parameters: Parameters) -> dict[ComponentType, float]:
    """Return the rates that a server announces for the components that it has items of."""
    return {
        component: rate_hz
        for component in WIRE_ORDER
        if num_described_items(parameters, component)
        and (rate_hz := described_rate_hz(parameters, component)) is not None
    }


def plan_streams(parameters: Parameters | None) -> StreamPlan:
    """Return the plan for a server with these parameters; None if it gave none."""
    if parameters is None:
        return StreamPlan(limitation=_no_rates("its components"))
    rates_hz = announced_rates_hz(parameters)
    described = [component for component in WIRE_ORDER if num_described_items(parameters, component)]
    if not rates_hz:
        return StreamPlan(limitation="" if len(described) == 1 else _no_rates("its components"))
    groups: list[set[ComponentType]] = []  # each of one rate, the slowest first
    slowest_hz = 0.0  # of the newest group
    for component, rate_hz in sorted(rates_hz.items(), key=itemgetter(1)):
        if not groups or rate_hz > slowest_hz * _SAME_RATE:
            groups.append(set())
            slowest_hz = rate_hz
        groups[-1].add(component)
    ordered = [tuple(each for each in WIRE_ORDER if each in group) for group in groups]
    first = tuple(each for each in WIRE_ORDER if not any(each in group for group in groups[1:]))
    unrated = [component for component in described if component not in rates_hz]
    return StreamPlan(
        (first, *ordered[1:]),
        tuple(rates_hz[group[0]] for group in ordered),
        _no_rates(keys_text(unrated)) if unrated else "",
    )


def _no_rates(components: str) -> str:
    return (
        f"the server does not announce the rates of {components}, so they share one connection, on which all "
        "components arrive at the rate of the slowest"
    )


def keys_text(components: Sequence[ComponentType]) -> str:
    """Return for example "3d, 6d and event"."""
    *others, last = (component.key for component in components)
    return f"{', '.join(others)} and {last}" if others else last


LATE_S: Final = 1.0
"""How long frames must be late without interruption before a lower rate is requested."""

FIRST_WAIT_S: Final = 10.0
MAX_WAIT_S: Final = 300.0
"""How long frames must be in time before a higher rate is requested: at first, and at most."""

MAX_HALVINGS: Final = 8
"""The lowest rate is 1/256 of the configured one."""


def request_forms(
    rate: Rate, components: Sequence[ComponentType], server_rate_hz: float | None
) -> list[StreamFrames]:
    """Return the StreamFrames commands to try, in order, beginning with the configured rate and components.

    Some servers know neither ``Frequency:n`` nor ``AllFrames`` nor component names (field note 2). The
    alternatives are: the same rate without names; the divisor 1 instead of AllFrames, or the divisor of
    ``server_rate_hz`` (the rate in the parameters, if any) nearest to a frequency; the server's default.
    """
    names = () if set(components) == set(WIRE_ORDER) else tuple(components)
    rates: list[Rate] = [rate]
    if isinstance(rate, AllFrames):
        rates.append(FrequencyDivisor(1))
    elif isinstance(rate, Frequency) and server_rate_hz:
        rates.append(FrequencyDivisor(max(1, round(server_rate_hz / rate.hz))))
    wanted = [StreamFrames(rate, names), *(StreamFrames(each) for each in rates), StreamFrames()]
    return list(dict.fromkeys(wanted))


def halved(rate: Rate | None, times: int) -> Rate | None:
    """Return ``rate`` halved ``times`` times. None, the server's default, is taken for all frames."""
    if times == 0:
        return rate
    match rate:
        case Frequency(hz):
            return Frequency(hz / 2**times)
        case FrequencyDivisor(divisor):
            return FrequencyDivisor(divisor * 2**times)
        case _:
            return FrequencyDivisor(2**times)


class LagControl:
    """Decides how often to halve the configured rate, from how late the frames are.

    After LATE_S of late frames it halves the rate once more (a step down). After ``wait_s`` of frames in
    time it undoes one halving (a step up), until the rate is as configured. A step up fails if a step down
    follows within ``wait_s``; then ``wait_s`` doubles, up to MAX_WAIT_S. If a step down follows later,
    ``wait_s`` returns to FIRST_WAIT_S. This avoids retrying the full rate on a link that carries half of it.

    If the rate must not change (``adapt_rate: false``), let ``max_halvings`` be 1: one halving then means
    that frames are late, and none that they are in time. It is logged as rarely as a rate would change.
    """

    def __init__(self, max_lag_s: float, max_halvings: int = MAX_HALVINGS) -> None:
        self._max_lag_s = max_lag_s
        self._max_halvings = max_halvings
        self.halvings = 0
        self.is_late = False
        """Whether the newest frame was late."""
        self.wait_s = FIRST_WAIT_S
        self._since_s: float | None = None  # since when frames are late, or in time, at the current rate
        self._stepped_up_s: float | None = None

    def observe(self, now_s: float, lag_s: float) -> bool:
        """Process the lag of one frame; return whether ``halvings`` changed."""
        is_late = lag_s > self._max_lag_s
        if is_late is not self.is_late or self._since_s is None:
            self.is_late = is_late
            self._since_s = now_s
            return False
        held_s = now_s - self._since_s
        if is_late and held_s >= LATE_S and self.halvings < self._max_halvings:
            self.halvings += 1
            if self._stepped_up_s is not None:
                failed = now_s - self._stepped_up_s < self.wait_s
                self.wait_s = min(2 * self.wait_s, MAX_WAIT_S) if failed else FIRST_WAIT_S
                self._stepped_up_s = None
        elif not is_late and held_s >= self.wait_s and self.halvings > 0:
            self.halvings -= 1
            self._stepped_up_s = now_s
        else:
            return False
        self._since_s = now_s
        return True

    def restart(self) -> None:
        """Forget how late the previous frames were, because the next ones do not continue them."""
        self.is_late = False
        self._since_s = None
