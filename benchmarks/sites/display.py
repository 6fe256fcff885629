"""A display far away, which gets 30 frames a second over a narrow link: how old is what it shows."""

import time
from typing import Any, Final

from benchmarks import processes
from benchmarks.processes import Worker
from benchmarks.report import Goal, Progress, Table
from benchmarks.sites.fan_out import RATE_HZ
from benchmarks.sites.network import SITE_DEVICE
from benchmarks.sites.subscribers import percentile_ms, received
from benchmarks.sites.two_sites import TwoSites
from benchmarks.workbench import GATEWAY
from benchmarks.workloads import LAB, Paced, send

TITLE: Final = "A display on site B, with the link at 2 Mbit/s"
LINK_BITS_PER_S: Final = 2e6
DELAY_MS: Final = 40.0
GOAL_MS: Final = 100.0
DISPLAY_HZ: Final = 30
_KEYS: Final = (f"mocap/{GATEWAY}/3d", f"mocap/{GATEWAY}/6d")
_SETTLE_S: Final = 3.0

_DOWNSAMPLING: Final[dict[str, Any]] = {
    "id": "displays",
    "interfaces": [SITE_DEVICE],
    "flows": ["egress"],
    "messages": ["put"],
    # Zenoh drops what comes earlier than 1/freq after the message before. With a fifth more than the wanted
    # rate, jitter does not halve it.
    "rules": [{"key_expr": key, "freq": 1.2 * DISPLAY_HZ} for key in _KEYS],
}


def _lasting_s(quick: bool) -> float:
    return 20.0 if quick else 600.0


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return _lasting_s(quick) + 15


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return how old messages are when they arrive, and when the next one arrives."""
    lasting_s = _lasting_s(quick)
    progress.step(f"{lasting_s:g} s", 0)
    with (
        Worker(send, LAB, [GATEWAY]) as sender,
        TwoSites(delay_ms=DELAY_MS, a_settings={"downsampling": [_DOWNSAMPLING]}) as sites,
        sites.a.gateway("gateway", [processes.source(GATEWAY, sender.started[GATEWAY])]),
        sites.b.subscribers(1, _KEYS) as display,
    ):
        sites.network.limit(LINK_BITS_PER_S)
        sender.send(Paced(GATEWAY, round((_SETTLE_S + lasting_s + 1) * RATE_HZ), RATE_HZ))
        processes.wait_until(lambda: len(display.look()[0]) == len(_KEYS), "the display has both components")
        time.sleep(_SETTLE_S)
        display.take()
        bytes_before = sites.network.bytes_to_b()
        began_s = time.monotonic()
        time.sleep(lasting_s)
        reports = display.take()
        took_s = time.monotonic() - began_s
        link_bytes = sites.network.bytes_to_b() - bytes_before
        sender.reply()
    total = received(reports)
    return {
        "seconds": lasting_s,
        "link_mbit_per_s": round(8e-6 * link_bytes / took_s, 3),
        "rates_hz": {key.rpartition("/")[2]: round(reports[0][key]["messages"] / took_s, 1) for key in _KEYS},
        "age_ms": _percentiles(total.ages_us),
        "age_before_ms": _percentiles(total.ages_before_us),
    }


def _percentiles(ages_us: Any) -> dict[str, float]:
    return {f"p{each:g}": round(percentile_ms(ages_us, each), 1) for each in (50, 99, 100)}


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    names = {"p50": "p50", "p99": "p99", "p100": "largest"}
    rows = [
        ["age of a message when it arrives, ms", *(f"{result['age_ms'][name]:.0f}" for name in names)],
        [
            "age of the newest data when the next arrives, ms",
            *(f"{result['age_before_ms'][name]:.0f}" for name in names),
        ],
    ]
    rates = ", ".join(f"{key} {rate:g} Hz" for key, rate in result["rates_hz"].items())
    note = (
        f"For {result['seconds']:g} s; the link has a delay of {DELAY_MS:g} ms. The gateway publishes the "
        f"lab workload at {RATE_HZ} Hz; the router of site A leaves out frames. Received: {rates}, with "
        f"{result['link_mbit_per_s']:.2f} Mbit/s on the link."
    )
    return [Table(TITLE, ["what", *names.values()], rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return how old the data on the display becomes."""
    largest_ms, p99_ms = (result["age_before_ms"][name] for name in ("p100", "p99"))
    slowest_hz = min(result["rates_hz"].values())
    return [
        Goal(
            f"display: age of the newest data, {result['seconds']:g} s",
            f"at most the link's delay + {GOAL_MS:g} ms = {DELAY_MS + GOAL_MS:g} ms",
            f"at most {largest_ms:.0f} ms, p99 {p99_ms:.0f} ms",
            largest_ms <= DELAY_MS + GOAL_MS,
        ),
        Goal(
            "display: rate",
            f"{DISPLAY_HZ} Hz",
            f"{slowest_hz:.1f} Hz",
            slowest_hz >= DISPLAY_HZ - 1,
        ),
    ]
