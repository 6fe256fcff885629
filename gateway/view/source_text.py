"""What the panel says about one source, as HTML: state, rates, latency, losses."""

from collections.abc import Iterator, Mapping
from typing import Final

from gateway.live.component import LiveComponent
from gateway.live.latency import Percentiles
from gateway.live.live_data import LiveData, LiveSource
from gateway.rtc3d.components import WIRE_ORDER
from gateway.view.loss_text import losses_html
from gateway.view.state_text import gateway_states, states_html
from gateway.view.texts import (
    age_text,
    count_text,
    counted,
    html_text,
    percentiles_text,
    rate_text,
    table,
)

_CLOCKS_DIFFER_MS: Final = (-0.5, 1000.0)
"""A median latency between computers outside of these says that their clocks differ."""


def source_html(
    source: LiveSource, shown: Mapping[str, Percentiles], *, is_take: bool, is_paused: bool = False
) -> str:
    """Return everything about a source but its markers, tools and events.

    ``shown`` is the latency from the arrival here to the browsers, by component. A take has no gateway now,
    so its latency to here is left out, and if it ``is_paused``, it has no rate.
    """
    parts = [f"<h3>{html_text(source.name)}</h3>"]
    if not (is_take and (source.is_silent or is_paused)):
        parts.append(states_html(gateway_states(source)))
    parts += [f"<p class=dim>{line}</p>" for line in _origin(source)]
    components = _components(source)
    if components:
        parts.append(_rates_table(source, components, is_take=is_take, is_paused=is_paused))
        parts.append(_latency_table(components, shown, is_take=is_take))
        parts += [f"<p class=waiting>{text}</p>" for text in clock_warning(components) if not is_take]
    parts.append(losses_html(source, components))
    return f"<section>{''.join(parts)}</section>"


def ignored_html(live: LiveData) -> str:
    """Say what was received and belongs to no source."""
    ignored = (
        (live.num_foreign, "of another program"),
        (live.num_beyond, "of more sources or keys than can be shown"),
        (live.num_defects, "because of a defect in this program"),
    )
    texts = [f"{counted(number, 'message')} {why}" for number, why in ignored if number]
    return f"<p class=waiting>left out: {', '.join(texts)}</p>" if texts else ""


def clock_warning(components: Mapping[str, LiveComponent]) -> Iterator[str]:
    """Say that latencies from the gateway to this program are wrong, if the clocks seem to differ."""
    medians = [each.latency.to_here.p50_ms for each in components.values() if each.latency.to_here]
    low_ms, high_ms = _CLOCKS_DIFFER_MS
    worst_ms = max(medians, key=abs, default=0.0)
    if worst_ms < low_ms:
        yield (
            f"This computer’s clock is at least {age_text(-worst_ms / 1000)} behind that of the gateway’s "
            "computer, so the latency from there to here is not known."
        )
    elif worst_ms > high_ms:
        yield (
            f"Messages seem to take {age_text(worst_ms / 1000)} from the gateway to here. Probably the "
            "clocks of the two computers differ."
        )


def _components(source: LiveSource) -> dict[str, LiveComponent]:
    # Threads that receive add components, and after each the series of its messages.
    keys = [each.key for each in WIRE_ORDER if each.key in source.series_by_key]
    return {key: source.components[key] for key in keys}


def _origin(source: LiveSource) -> Iterator[str]:
    """Say where the data come from, and whether the gateway records them."""
    status = source.newest_status
    if status is None:
        return
    on_host = f" on {html_text(status.host)}" if status.host else ""
    yield f"server {html_text(status.server)} · gateway {html_text(status.gateway_version)}{on_host}"
    if source.running_take is not None and not source.is_silent:
        yield (
            f"recording the take {html_text(source.running_take)}"
            if source.running_take
            else "recording no take"
        )


def _rates_table(
    source: LiveSource, components: Mapping[str, LiveComponent], *, is_take: bool, is_paused: bool
) -> str:
    rows = []
    for key, component in components.items():
        rows.append(
            (
                key,
                count_text(len(component.newest_items)) if key != "event" else "",
                _rate(component, is_take=is_take, is_paused=is_paused) if key != "event" else "",
                count_text(source.series_by_key[key].num_messages),
            )
        )
    return table(("", "items", "Hz", "messages"), rows)


def _rate(component: LiveComponent, *, is_take: bool, is_paused: bool) -> str:
    """Return the rate, and the announced one if there is one. That of a take depends on its speed."""
    if component.is_stopped:
        return f"<span class=bad>stopped {age_text(component.age_s or 0.0)} ago</span>"
    if is_paused:
        return "paused"
    announced_hz = component.announced_rate_hz
    text = rate_text(component.rate_hz)
    if announced_hz is None:
        return text
    if component.is_slow and not is_take:
        text = f"<span class=waiting>{text}</span>"
    return f"{text} <span class=dim>of {rate_text(announced_hz)}</span>"


def _latency_table(
    components: Mapping[str, LiveComponent], shown: Mapping[str, Percentiles], *, is_take: bool
) -> str:
    headings = ("ms, p50 / p99", "captured → gateway", "→ here", "→ browser")
    rows = [
        (
            key,
            percentiles_text(component.latency.to_gateway),
            percentiles_text(component.latency.to_here),
            percentiles_text(shown.get(key)),
        )
        for key, component in components.items()
    ]
    if is_take:
        return table(headings[:2], [row[:2] for row in rows])
    return table(headings, rows)
