"""What the history costs: CPU time per message, memory, and CPU while somebody asks for it."""

import json
import statistics
import time
from collections.abc import Generator
from typing import Any, Final

from benchmarks.own_cost import FedGateway
from benchmarks.processes import Worker, cpu_s, leave_measured_core
from benchmarks.queries import num_gaps
from benchmarks.report import Goal, Progress, Table
from benchmarks.workbench import GATEWAY, Lab
from benchmarks.workloads import DENSE
from gateway.messages.encode import MESSAGE_TYPES
from gateway.messages.frame_run import FRAME_OVERHEAD_BYTES
from gateway.outputs.zenoh.subscriber import open_zenoh

TITLE: Final = "Cost of the history"
GOAL_US: Final = 0.5
_BLOCK_FRAMES: Final = 4096
_MINUTE_S: Final = 60
_WAIT_S: Final = 5.0
_PREFIX: Final = f"mocap/{GATEWAY}"


def ask_history(endpoint: str, last_s: float, seconds: float) -> Generator[Any, Any, None]:
    """Ask in a Worker for what the history has of the last seconds of each component.

    The reply to "size" is the number of bytes in the history. To other requests, it is the number of answers
    and of their bytes per second, after ``seconds``.
    """
    leave_measured_core()
    with open_zenoh(endpoint) as session:
        while not _facts(session, f"{_PREFIX}/history"):
            time.sleep(0.1)
        request = yield None
        while True:
            request = yield _kept_bytes(session) if request == "size" else _ask(session, last_s, seconds)


def _ask(session: Any, last_s: float, seconds: float) -> dict[str, float]:
    answers = num_bytes = 0
    began_s = time.perf_counter()
    end_s = began_s + seconds
    options = dict.fromkeys(MESSAGE_TYPES, "")
    while time.perf_counter() < end_s:
        for component, option in options.items():
            selector = f"{_PREFIX}/{component.key}?{option or f'last_s={last_s:g}'}"
            for facts, size in _facts(session, selector):
                answers, num_bytes = answers + 1, num_bytes + size
                is_end = facts["to"] >= facts["newest"]
                options[component] = "" if is_end else f"from={facts['to'] + 1}"
    took_s = time.perf_counter() - began_s
    return {"answers_per_s": round(answers / took_s, 1), "bytes_per_s": round(num_bytes / took_s)}


def _facts(session: Any, selector: str) -> list[tuple[dict[str, Any], int]]:
    """Return what a gateway says about its answer, and the size of that; nothing without an answer."""
    return [
        (json.loads(reply.ok.attachment.to_bytes()) if reply.ok.attachment else {}, len(reply.ok.payload))
        for reply in session.get(selector, timeout=_WAIT_S)
        if reply.ok is not None
    ]


def _kept_bytes(session: Any) -> int:
    for reply in session.get(f"{_PREFIX}/history", timeout=_WAIT_S):
        if reply.ok is not None:
            return int(json.loads(reply.ok.payload.to_bytes())["num_bytes"])
    return 0


def _plan(quick: bool) -> tuple[int, float, float]:
    """Return the number of rounds, how many seconds are asked for, and how long each measurement takes."""
    return (6, 3.0, 3.0) if quick else (30, 30.0, 15.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, last_s, seconds = _plan(quick)
    return rounds * 0.1 + last_s + 2 * seconds + 10


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the CPU time per frame, the growth of the memory, and the CPU share without and with asker."""
    rounds, last_s, seconds = _plan(quick)
    progress.step("CPU time per message", 0)
    cpu_us = _cpu_us_per_frame(rounds)
    progress.step(f"asking for the last {last_s:g} s", 0.2)
    with Lab(reads=True) as lab, Worker(ask_history, lab.endpoint, last_s, seconds) as asker:
        before_bytes, began_s = asker.ask("size"), time.perf_counter()
        time.sleep(last_s)
        lab.take_received()
        shares = [_cpu_share(lab.gateway.pid, seconds)]
        after_bytes, took_s = asker.ask("size"), time.perf_counter() - began_s
        asker.send("again and again")
        shares.append(_cpu_share(lab.gateway.pid, seconds))
        answers = asker.reply()
        lost = sum(num_gaps(received) for received in lab.take_received())
    return {
        "cpu_us_per_frame": cpu_us,
        "lab_bytes_per_s": round((after_bytes - before_bytes) / took_s),
        "last_s": last_s,
        "cpu_shares": [round(share, 4) for share in shares],
        **answers,
        "lost": lost,
    }


def _cpu_us_per_frame(rounds: int) -> dict[str, list[float]]:
    """Return the time per frame of five components in blocks with and without history, which alternate."""
    values: dict[str, list[float]] = {"on": [], "off": []}
    fed = {name: FedGateway(history=name == "on") for name in values}
    for number in range(rounds + 1):
        for name, gateway in fed.items():
            us = 1e6 * gateway.run(_BLOCK_FRAMES, 1) / _BLOCK_FRAMES
            if number:  # the first blocks fill caches
                values[name].append(float(f"{us:.4g}"))
    for gateway in fed.values():
        gateway.close()
    return values


def _cpu_share(pid: int, seconds: float) -> float:
    began_s, before_s = time.perf_counter(), cpu_s(pid)
    time.sleep(seconds)
    return (cpu_s(pid) - before_s) / (time.perf_counter() - began_s)


def _cost_us(result: dict[str, Any]) -> float:
    """Return the time per message: the median difference of neighbouring blocks."""
    values = result["cpu_us_per_frame"]
    differences = [on - off for on, off in zip(values["on"], values["off"], strict=True)]
    return float(statistics.median(differences)) / len(MESSAGE_TYPES)


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    values = result["cpu_us_per_frame"]
    without, during = result["cpu_shares"]
    packet = DENSE.packet()
    dense_bytes = len(packet) + FRAME_OVERHEAD_BYTES
    rows = [
        ["CPU per frame of five components, with the history", f"{statistics.median(values['on']):.2f} µs"],
        ["the same without", f"{statistics.median(values['off']):.2f} µs"],
        ["cost per message", f"{_cost_us(result):.2f} µs"],
        ["memory per minute, lab", f"{_MINUTE_S * result['lab_bytes_per_s'] / 2**20:.0f} MiB"],
        ["memory per minute, dense", f"{_MINUTE_S * DENSE.rate_hz * dense_bytes / 2**20:.0f} MiB"],
        ["CPU of the gateway with lab, without asker", f"{without:.1%} of a core"],
        [f"while one asks for the last {result['last_s']:g} s again and again", f"{during:.1%} of a core"],
        ["answers per second to the asker", f"{result['answers_per_s']:.0f}"],
        ["messages to the asker", f"{result['bytes_per_s'] / 1e6:.1f} MB/s"],
        ["messages of the stream lost meanwhile", str(result["lost"])],
    ]
    note = "The memory is what there would be without the limit `history.max_bytes`."
    return [Table(TITLE, ["what", "measured"], rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the CPU time per message."""
    cost_us = _cost_us(result)
    what = "cost of the history per message"
    return [Goal(what, f"at most {GOAL_US:g} µs", f"{cost_us:.2f} µs", cost_us <= GOAL_US)]
