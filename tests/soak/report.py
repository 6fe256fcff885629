"""The report of a run, in Markdown for docs/dev/reliability.md."""

import platform
import statistics
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Final

from gateway import version_text
from tests.soak.soak import (
    BACKOFF_S,
    COMPONENTS,
    MAX_SILENCE_S,
    NUM_TOOLS,
    RATE_HZ,
    RECOVERY_LIMIT_S,
    STALL_S,
    Round,
    Soak,
    Usage,
)

MIN_GROWTH_MIB: Final = 50
"""The least growth of memory for which the report lists an attack."""

_NUM_USAGE_COLUMNS: Final = 6


def report(soak: Soak) -> str:
    """Return the report of a run that has ended."""
    sections = [
        _introduction(soak),
        _totals(soak),
        "What the gateway used after each part of the time, memory in MiB:",
        _usage(soak),
        f"The healthy source during the attacks with a silence above {_ms(MAX_SILENCE_S)} ms or with missing "
        f"messages, or in whose rounds the gateway's memory grew by more than {MIN_GROWTH_MIB} MiB: its "
        "longest silence at a subscriber and its missing messages, the lines that all sources together "
        "logged in one round at most, and the largest growth of the memory in one round.",
        _attacks(soak.rounds),
        "Frames that the simulator of the disturbed source sent, and messages that a subscriber received, by "
        "component. Lost frames were in transit on connections that a fault ended, or are counted as drops "
        "below. A gap is a sequence number that was lost between gateway and subscriber.",
        _table(
            ("component", "sent", "received", "lost", "gaps"),
            (
                (
                    key,
                    soak.sent[key],
                    soak.messages.received[key],
                    soak.sent[key] - soak.messages.received[key],
                    soak.messages.gaps[key],
                )
                for key in COMPONENTS
            ),
        ),
        _drops(soak),
        "The time from the end of a fault until data of the disturbed source flowed again. It includes the "
        "time that the gateway took to notice the fault and waited to reconnect:",
        _faults(soak.rounds),
    ]
    wrapped = (each if each.startswith("|") else textwrap.fill(each, 120) for each in sections)
    return "\n\n".join(wrapped) + "\n"


def _table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table whose columns, except for the first, are numbers."""
    titles_line, *lines = (f"| {' | '.join(map(str, cells))} |" for cells in [titles, *rows])
    return "\n".join([titles_line, f"|---|{'--:|' * (len(titles) - 1)}", *lines])


def _introduction(soak: Soak) -> str:
    return (
        f"Random faults and attacks for {soak.minutes:g} minutes (`make soak SOAK_MINUTES="
        f"{soak.minutes:g}`, seed {soak.seed}), {datetime.now(UTC):%Y-%m-%d}, version {version_text()}, "
        f"Python {platform.python_version()}, uvloop {version('uvloop')}, {platform.machine()}. "
        f"The gateway has two sources at {RATE_HZ:g} Hz, one with {NUM_TOOLS} tools, each on a key of its "
        "own, and some whose servers are hostile. All outputs are on. Each round reloads a changed "
        "configuration (one source more or less, other names on ROS 2), begins one attack and one fault of "
        "the first source's simulator (see `rtc3d-gateway simulate --list-faults`), ends both after a few "
        "seconds, and waits until data of that source flows again. Nothing disturbs the server of the "
        f"healthy source. The first source's stall_timeout_s is {STALL_S:g} and its reconnect.max_delay_s is "
        f"{BACKOFF_S:g}."
    )


def _totals(soak: Soak) -> str:
    messages, gateway = soak.messages, soak.gateway_report
    rows: list[tuple[str, object]] = [
        ("rounds", len(soak.rounds)),
        ("rounds after which no data flowed", sum(each.recovery_s is None for each in soak.rounds)),
        ("reconnects of the disturbed source", messages.status.streams[0].reconnects),
        ("malformed messages", messages.malformed),
        ("messages received twice", messages.repeated),
        ("healthy source: messages received", gateway.num_received),
        ("healthy source: messages missing", gateway.num_missing),
        ("healthy source: reconnects", gateway.num_reconnects),
        *(
            (f"healthy source: longest silence on {output}, ms", _ms(silence_s))
            for output, silence_s in _longest_silence_s(soak.rounds).items()
        ),
        (f"rounds with a silence above {_ms(MAX_SILENCE_S)} ms", len(_silent_rounds(soak.rounds))),
        ("most lines logged about one source in a minute", soak.log_lines_per_minute),
        ("exit status", gateway.exit_status),
        ("time to stop, s", f"{gateway.stop_s:.2f}"),
    ]
    return _table(("what", "count"), rows)


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.0f}"


def _longest_silence_s(rounds: Sequence[Round]) -> dict[str, float]:
    return {
        output: max(each.longest_silence_s[output] for each in rounds)
        for output in rounds[0].longest_silence_s
    }


def _silent_rounds(rounds: Sequence[Round]) -> list[Round]:
    return [each for each in rounds if max(each.longest_silence_s.values()) > MAX_SILENCE_S]


def _usage(soak: Soak) -> str:
    usage = [soak.start, *(each.usage for each in soak.rounds)]
    parts = [number / (_NUM_USAGE_COLUMNS - 1) for number in range(_NUM_USAGE_COLUMNS)]
    shown = [usage[round(part * (len(usage) - 1))] for part in parts]
    shown.append(Usage(*map(max, zip(*usage, strict=True))))
    rows: list[list[object]] = [
        ["memory", *(f"{each.memory_kib / 1024:.1f}" for each in shown)],
        ["threads", *(each.threads for each in shown)],
        ["descriptors", *(each.descriptors for each in shown)],
    ]
    return _table(["time", *(f"{part:.0%}" for part in parts), "peak"], rows)


def _attacks(rounds: Sequence[Round]) -> str:
    by_attack: defaultdict[str, list[Round]] = defaultdict(list)
    growth_kib: defaultdict[str, int] = defaultdict(int)
    for before, after in zip([rounds[0], *rounds], rounds, strict=False):
        by_attack[after.attack].append(after)
        growth_kib[after.attack] = max(
            growth_kib[after.attack], after.usage.memory_kib - before.usage.memory_kib
        )
    rows = [
        (
            attack,
            len(done),
            *(_ms(silence_s) for silence_s in _longest_silence_s(done).values()),
            sum(each.missing for each in done),
            max(each.lines for each in done),
            f"{growth_kib[attack] / 1024:.1f}",
        )
        for attack, done in sorted(by_attack.items())
        if _silent_rounds(done)
        or any(each.missing for each in done)
        or growth_kib[attack] > MIN_GROWTH_MIB * 1024
    ]
    outputs = [f"silence on {output}, ms" for output in rounds[0].longest_silence_s]
    return _table(("attack", "rounds", *outputs, "missing", "lines", "growth, MiB"), rows)


def _drops(soak: Soak) -> str:
    status = soak.messages.status
    rows = [(loss.cause, loss.messages, loss.frames) for loss in status.streams[0].drops]
    for output in status.outputs:
        rows += [(f"{output.name}: {loss.cause}", loss.messages, loss.frames) for loss in output.drops]
    return _table(("lost, by cause", "messages", "frames"), rows)


def _faults(rounds: Sequence[Round]) -> str:
    recoveries_s: defaultdict[str, list[float]] = defaultdict(list)
    for each in rounds:
        recoveries_s[each.fault].append(RECOVERY_LIMIT_S if each.recovery_s is None else each.recovery_s)
    rows = [
        (fault, len(times), f"{statistics.median(times):.2f}", f"{max(times):.2f}")
        for fault, times in sorted(recoveries_s.items())
    ]
    return _table(("fault", "rounds", "median s", "longest s"), rows)
