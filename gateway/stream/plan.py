"""Which components of a server share a connection: those that it sends at the same rate (§5.3.5)."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.server_description import described_rate_hz, num_described_items

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
    groups = _groups(rates_hz)
    if not groups:
        return StreamPlan(limitation="" if len(described) == 1 else _no_rates("its components"))
    fast = {component for group in groups[1:] for component in group}
    first = tuple(component for component in WIRE_ORDER if component not in fast)
    unrated = [component for component in described if component not in rates_hz]
    return StreamPlan(
        (first, *groups[1:]),
        tuple(rates_hz[group[0]] for group in groups),
        _no_rates(keys_text(unrated)) if unrated else "",
    )


def _groups(rates_hz: Mapping[ComponentType, float]) -> list[Components]:
    """Return the components with rates in groups of one rate, the slowest group first."""
    groups: list[list[ComponentType]] = []
    for component in sorted(rates_hz, key=lambda component: rates_hz[component]):
        if groups and rates_hz[component] <= rates_hz[groups[-1][0]] * _SAME_RATE:
            groups[-1].append(component)
        else:
            groups.append([component])
    return [tuple(component for component in WIRE_ORDER if component in group) for group in groups]


def _no_rates(components: str) -> str:
    return (
        f"the server does not announce the rates of {components}, so they share one connection, on which all "
        "components arrive at the rate of the slowest"
    )


def keys_text(components: Sequence[ComponentType]) -> str:
    """Return for example "3d, 6d and event"."""
    *others, last = (component.key for component in components)
    return f"{', '.join(others)} and {last}" if others else last


def rate_text(rate_hz: float) -> str:
    """Return a rate with at most one decimal."""
    return f"{rate_hz:.1f}".removesuffix(".0")
