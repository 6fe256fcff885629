"""A link that is too slow for a while: loss is counted, and a recorder gets it later."""

import time
from typing import Any, Final

from benchmarks import processes
from benchmarks.processes import Worker
from benchmarks.report import Goal, Progress, Table
from benchmarks.sites.fan_out import RATE_HZ, connect
from benchmarks.sites.recorder import Recorder, figures_text
from benchmarks.sites.subscribers import percentile_ms, received
from benchmarks.sites.two_sites import TwoSites
from benchmarks.workbench import GATEWAY
from benchmarks.workloads import DENSE, Paced, cuts, send

TITLE: Final = (
    "A link that is too slow for a while: the dense workload, one subscriber and one recorder on each site"
)
_COMPONENTS: Final = 5
_BEFORE_S: Final = 2.0
_NEEDED_BITS_PER_S: Final = 8 * RATE_HZ * sum(cut.last - cut.first for cut in cuts(DENSE.packet()))
"""What the messages need, without what Zenoh, TCP and IP add: a quarter."""


def _plan(quick: bool) -> tuple[tuple[float, ...], float, float]:
    """Return the rates as shares of what is needed, and how long it is slow and then not, in s."""
    return ((0.5,), 4.0, 6.0) if quick else ((0.9, 0.5, 0.25), 20.0, 30.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    shares, slow_s, room_s = _plan(quick)
    return len(shares) * (_BEFORE_S + slow_s + room_s + 10)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return a row for each rate of the link."""
    shares, slow_s, room_s = _plan(quick)
    rows = []
    for number, share in enumerate(shares):
        progress.step(f"{share:.0%} of the rate that is needed", number / len(shares))
        rows.append({"share": share, **run(share, slow_s, room_s)})
    return {"slow_s": slow_s, "room_s": room_s, "rows": rows}


def run(share: float, slow_s: float, room_s: float) -> dict[str, Any]:
    """Return what a link loses that has ``share`` of its rate for ``slow_s``, and room for ``room_s``."""
    frames = round((_BEFORE_S + slow_s + room_s) * RATE_HZ)
    with (
        Worker(send, DENSE, [GATEWAY]) as sender,
        TwoSites() as sites,
        sites.a.gateway("gateway", [processes.source(GATEWAY, sender.started[GATEWAY])]),
        sites.a.subscribers(1) as subscriber_a,
        sites.b.subscribers(1) as subscriber_b,
    ):
        connect(sender, (subscriber_a, subscriber_b))
        recorder_a, recorder_b = (Recorder(site, site.folder / "take.lcmlog") for site in (sites.a, sites.b))
        sender.send(Paced(GATEWAY, frames, RATE_HZ))
        with recorder_a, recorder_b:
            time.sleep(_BEFORE_S)
            before = received(subscriber_a.take())
            subscriber_b.take()
            sites.network.limit(share * _NEEDED_BITS_PER_S)
            time.sleep(slow_s)
            slow = received(subscriber_b.look())
            sites.network.limit(None)
            sender.reply()
            expected = frames * _COMPONENTS - before.messages
            at_a = received(subscriber_a.wait_for(expected))
            recordings = recorder_a.stop(), recorder_b.stop()
            at_b = received(subscriber_b.take())
    return {
        "lost_on_a": expected - at_a.messages + before.missing,
        "silence_on_a_ms": round(at_a.longest_silence_ms),
        "missed_on_b": at_b.missing,
        "age_ms": {f"p{each:g}": round(percentile_ms(slow.ages_us, each), 1) for each in (50, 99)},
        "recordings": [each.figures() for each in recordings],
        "different": recordings[0].differs_from(recordings[1]),
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = [
        [
            f"{row['share']:.0%}, {row['share'] * _NEEDED_BITS_PER_S / 1e6:.1f} Mbit/s",
            str(row["lost_on_a"]),
            f"{row['silence_on_a_ms']}",
            str(row["missed_on_b"]),
            f"{row['age_ms']['p50']:.0f} / {row['age_ms']['p99']:.0f}",
            *(figures_text(recording) for recording in row["recordings"]),
            str(row["different"]),
        ]
        for row in result["rows"]
    ]
    columns = [
        "rate of the link",
        "lost on A",
        "longest silence on A, ms",
        "missed on B",
        "age on B meanwhile, ms, p50 / p99",
        "recorder on A",
        "recorder on B",
        "messages that differ",
    ]
    note = (
        f"The dense workload at {RATE_HZ} Hz. The link is too slow for {result['slow_s']:g} s. Then, it has "
        f"room for {result['room_s']:g} s, and both recorders are stopped. 100 % is what the messages "
        "need without headers."
    )
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return whether the loss was seen, and whether the recorders have everything."""
    rows = result["rows"]
    lost_on_a = sum(row["lost_on_a"] for row in rows)
    missed = [row["missed_on_b"] for row in rows]
    complete = [recording["complete"] for row in rows for recording in row["recordings"]]
    different = sum(row["different"] for row in rows)
    return [
        Goal("slow link: lost on site A", "none", str(lost_on_a), not lost_on_a),
        Goal(
            "slow link: loss is counted at its far end",
            "in each run",
            f"{min(missed)} to {max(missed)} messages",
            all(missed),
        ),
        Goal(
            "slow link: recordings on both sites",
            "complete and equal",
            f"{sum(complete)} of {len(complete)} complete, {different} messages differ",
            all(complete) and not different,
        ),
    ]
