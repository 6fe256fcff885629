"""How late the messages of a replay are, and how many a second are possible."""

import json
import re
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import lcm
import rtc3d

from benchmarks.processes import Worker, run_measured
from benchmarks.report import Goal, Progress, Table
from gateway.messages.encode import Stamp, encode_message
from gateway.outputs.lcm.connection import receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.outputs.zenoh.config import zenoh_config
from gateway.rtc3d.components import ITEM_DTYPES, Component, ComponentType
from tests.support.takes import encode_event

TITLE: Final = "A replay of 4400 messages/s as recorded"
MAX_LATENESS_MS: Final = 5.0
GOAL_HZ: Final = 100_000
_ITEMS: Final = {
    ComponentType.ANALOG: 69,
    ComponentType.FORCE: 2,
    ComponentType.MARKERS: 55,
    ComponentType.TOOLS: 6,
}
_ANALOG_HZ: Final = 2000
_FRAME_EVERY: Final = 10
_TAKE_S: Final = 20.0
_ENDPOINT: Final = "tcp/127.0.0.1:7531"
_URL: Final = "udpm://239.255.76.67:7731?ttl=0"
_REPORT: Final = re.compile(
    r"^([\d,]+) messages in [\d.]+ s \(([\d,]+) messages/s\)"
    r"(?:; late by ([\d.]+) ms \(p50\), ([\d.]+) ms \(p99\), ([\d.]+) ms at most)?",
    re.MULTILINE,
)
_NOBODY: Final = "nobody"
_ON_ZENOH: Final = ("--zenoh", "--connect", _ENDPOINT)
_ON_ZENOH_ALONE: Final = ("--zenoh", "--listen", _ENDPOINT)
_ON_LCM: Final = ("--lcm", "--url", _URL)
_RUNS: Final = (
    ("1", "Zenoh and LCM", ("--listen", _ENDPOINT, "--url", _URL), _NOBODY),
    ("1", "Zenoh", _ON_ZENOH, "zenoh"),
    ("10", "Zenoh and LCM", ("--listen", _ENDPOINT, "--url", _URL), _NOBODY),
    ("10", "Zenoh", _ON_ZENOH, "zenoh"),
    ("max", "Zenoh", _ON_ZENOH_ALONE, _NOBODY),
    ("max", "LCM", _ON_LCM, _NOBODY),
    ("max", "Zenoh and LCM", ("--listen", _ENDPOINT, "--url", _URL), _NOBODY),
    ("max", "Zenoh", _ON_ZENOH, "zenoh"),
    ("max", "LCM", _ON_LCM, "lcm"),
)
"""Rate, outputs, options and who subscribes."""


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return 3 * _seconds(quick) + 6 * len(_RUNS)


def _seconds(quick: bool) -> float:
    return 2.0 if quick else 10.0


def _write_take(path: Path, seconds: float) -> None:
    """Write a take of a laboratory: 55 markers and 6 tools at 200 Hz, analog and force at 2000 Hz."""
    start = 1_700_000_000_000_000
    parameters = rtc3d.parameters_t()
    parameters.utime, parameters.xml = start, "<Parameters></Parameters>"
    numbers = dict.fromkeys(_ITEMS, 0)
    with path.open("wb") as file:
        file.write(encode_event(0, start, b"MOCAP_LAB_PARAMETERS", parameters.encode()))
        for index in range(round(seconds * _ANALOG_HZ)):
            time_us = index * 1_000_000 // _ANALOG_HZ
            stamp = Stamp(start + time_us, start + time_us, 1, 1)
            for component, num_items in _ITEMS.items():
                if index % _FRAME_EVERY and component in {ComponentType.MARKERS, ComponentType.TOOLS}:
                    continue
                item_bytes = ITEM_DTYPES[component].itemsize
                content = struct.pack(">iqi", index, time_us, num_items) + bytes(num_items * item_bytes)
                encoded = Component(component, index, time_us, num_items, item_bytes, "big", content)
                message = encode_message(encoded, stamp, numbers[component])
                numbers[component] += 1
                channel = f"MOCAP_LAB_{component.key.upper()}".encode()
                file.write(encode_event(0, stamp.utime, channel, message))


def count_on_zenoh() -> Iterator[Any]:
    """Count messages in a Worker: yield how many have come since the last request."""
    import zenoh  # noqa: PLC0415 - in the worker only

    config = zenoh_config({})
    config.insert_json5("listen/endpoints", json.dumps([_ENDPOINT]))
    received: list[int] = []
    with zenoh.open(config) as session:
        session.declare_subscriber("replay/lab/*", lambda _sample: received.append(1))
        yield from _counts(received)


def count_on_lcm() -> Iterator[Any]:
    """Count messages in a Worker, as ``count_on_zenoh`` does."""
    received: list[int] = []
    channels = "REPLAY_LAB_.*"
    subscriber = LcmSubscriber(
        lcm.LCM(receiving_url(_URL)), channels, lambda _channel, _message: received.append(1)
    )
    yield from _counts(received)
    subscriber.close()


def _counts(received: list[int]) -> Iterator[Any]:
    yield None
    while True:
        before = -1
        while len(received) > before:  # until no more come
            before = len(received)
            time.sleep(0.5)
        yield len(received)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return what each of _RUNS has measured."""
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        take = Path(folder) / "take.lcmlog"
        _write_take(take, _TAKE_S)
        for index, (rate, outputs, options, who) in enumerate(_RUNS):
            progress.step(f"rate {rate} on {outputs}, {who} subscribes", index / len(_RUNS))
            command = [sys.executable, "-m", "gateway", "replay", str(take), "--rate", rate, *options]
            if rate != "max":
                command += ["--to", str(min(_TAKE_S, _seconds(quick) * float(rate)))]
            if who == _NOBODY:
                text, num_received = run_measured(command), None
            else:
                with Worker(count_on_zenoh if who == "zenoh" else count_on_lcm) as subscriber:
                    text = run_measured(command)
                    num_received = subscriber.ask("count")
            runs.append(_result(rate, outputs, who, text, num_received))
    return {"runs": runs}


def _result(rate: str, outputs: str, who: str, text: str, num_received: int | None) -> dict[str, Any]:
    found = _REPORT.search(text)
    if found is None:
        raise RuntimeError(text)
    num_messages, per_s = (int(number.replace(",", "")) for number in found.group(1, 2))
    # The parameters may be published again for a new subscriber.
    num_lost = None if num_received is None else max(0, num_messages - num_received)
    late_ms = None if found[3] is None else [float(number) for number in found.group(3, 4, 5)]
    return {
        "rate": rate,
        "outputs": outputs,
        "subscribes": who,
        "messages": num_messages,
        "per_s": per_s,
        "late_ms": late_ms,
        "lost": num_lost,
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the table of the result."""
    rows = []
    for run in result["runs"]:
        late = ["", "", ""] if run["late_ms"] is None else [f"{ms:.1f} ms" for ms in run["late_ms"]]
        who = f"{run['subscribes']} subscribes" if run["subscribes"] != _NOBODY else "nobody subscribes"
        lost = "" if run["lost"] is None else str(run["lost"])
        rows.append([f"--rate {run['rate']}, {run['outputs']}, {who}", f"{run['per_s']:,}", *late, lost])
    heading = ["replay", "messages/s", "late p50", "p99", "at most", "lost"]
    return [Table(TITLE, heading, rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the lateness at the recorded pace, and the rate without waiting."""
    late_ms = max(run["late_ms"][1] for run in result["runs"] if run["rate"] == "1")
    fastest = [run for run in result["runs"] if run["rate"] == "max" and run["subscribes"] == _NOBODY]
    slowest_hz = min(run["per_s"] for run in fastest)
    return [
        Goal(
            "lateness of a replay of 4400 messages/s, p99",
            f"below {MAX_LATENESS_MS:g} ms",
            f"{late_ms:.1f} ms",
            late_ms < MAX_LATENESS_MS,
        ),
        Goal(
            "replay as fast as possible",
            f"{GOAL_HZ:,} messages/s",
            f"{slowest_hz:,} messages/s",
            slowest_hz >= GOAL_HZ,
        ),
    ]
