"""What Python's ``live()`` costs a program, compared with a bare Zenoh subscriber that decodes nothing.

Both receive the same messages from one gateway, one after the other, again and again.
"""

import contextlib
import json
import socket
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from benchmarks import processes
from benchmarks.processes import Program, zenoh_session_config
from benchmarks.report import Goal, Pair, Progress, Table, table_cell
from benchmarks.workbench import simulator_command
from benchmarks.workloads import LAB, LAB_STREAMS, Workload
from tests.support.networks import free_port

TITLE: Final = "CPU time of a Python program that receives live data over Zenoh"
LIVE: Final = "live"
BARE: Final = "bare"
GOAL_TOOLS: Final = 0.03

TOOLS: Final = Workload(markers=0, tools=4, analog=0, plates=0, rate_hz=200, analog_rate_hz=200)
"""Four tools at 200 Hz, such as a robot follows."""

_CASES: Final = {
    "tools": (TOOLS, None, "mocap/lab/6d", "4 tools, 200 Hz"),
    "lab": (LAB, LAB_STREAMS, "mocap/lab/*", "55 markers and 6 tools, 200 Hz; 69 channels, 2000 Hz"),
}
_SOURCE: Final = "lab"
_NOTE: Final = (
    "The whole process, with Zenoh's threads. The bare subscriber takes each message from a queue and copies "
    "its bytes; `live()` also checks that none is missing, decodes them, and yields frames."
)


def _plan(quick: bool) -> tuple[int, float]:
    """Return the number of rounds, and how long each program is measured in s."""
    return (1, 3.0) if quick else (7, 5.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, lasting_s = _plan(quick)
    return len(_CASES) * (rounds * 2 * (lasting_s + 2) + 4)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the share of a core that each program takes, by case."""
    rounds, lasting_s = _plan(quick)
    shares: dict[str, dict[str, list[float]]] = {}
    for number, (case, (workload, streams, keys, text)) in enumerate(_CASES.items()):
        pair = Pair(LIVE, BARE)
        with _gateway(workload, streams) as endpoint:
            for each in range(rounds):
                progress.step(f"{text}, round {each + 1} of {rounds}", (number + each / rounds) / len(_CASES))
                for name in (LIVE, BARE):
                    command = [sys.executable, "-m", "benchmarks.live", name, endpoint, keys, str(lasting_s)]
                    pair.add(name, float(processes.run_measured(command)))
        shares[case] = pair.as_dict()
    return {"cpu_share": shares}


@contextlib.contextmanager
def _gateway(workload: Workload, streams: list[dict[str, Any]] | None) -> Iterator[str]:
    """Run a gateway and its server, and yield the gateway's endpoint."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
        port, listening = free_port(), free_port()
        endpoint = f"tcp/127.0.0.1:{listening}"
        stack.enter_context(Program(simulator_command(workload, port)))
        settings = {
            "sources": [processes.source(_SOURCE, port, streams)],
            "zenoh": {"config": zenoh_session_config("peer", listen=[endpoint])},
            "lcm": {"enabled": False},
            "metrics": {"port": free_port()},
        }
        stack.enter_context(processes.gateway(folder / "gateway.yaml", settings))
        processes.wait_until(lambda: _listens(listening), "the gateway listens")
        yield endpoint


def _listens(port: int) -> bool:
    with contextlib.suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the table of the result."""
    rows = []
    for case, shares in result["cpu_share"].items():
        pair = Pair.of(shares)
        cells = [f"{pair.median(name):.1%}" for name in (LIVE, BARE)]
        rows.append([_CASES[case][3], *cells, table_cell(pair)])
    columns = ["data", "live(), of a core", "bare subscriber, of a core", "ratio"]
    return [Table(TITLE, columns, rows, _NOTE)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the share of a core for four tools."""
    share = statistics.median(result["cpu_share"]["tools"][LIVE])
    return [
        Goal(
            "live() with 4 tools at 200 Hz",
            f"at most {GOAL_TOOLS:.0%} of a core",
            f"{share:.1%}",
            share <= GOAL_TOOLS,
        )
    ]


def _live_messages(endpoint: str, keys: str) -> Iterator[object]:
    from gateway.client import live  # noqa: PLC0415 - only the measured program

    components = () if keys.endswith("*") else (keys.rpartition("/")[2],)
    return iter(live(_SOURCE, connect=endpoint, components=components))


def _bare_messages(endpoint: str, keys: str) -> Iterator[object]:
    import zenoh  # noqa: PLC0415 - as above

    config = json.dumps(zenoh_session_config("client", connect=[endpoint]))
    session = zenoh.open(zenoh.Config.from_json5(config))
    subscriber = session.declare_subscriber(keys, zenoh.handlers.FifoChannel(1000))
    while True:
        yield subscriber.recv().payload.to_bytes()


_FIRST_MESSAGES: Final = 200


def main() -> None:
    """Receive for a while, and print which share of a core that took."""
    name, endpoint, keys, lasting_s = sys.argv[1:]
    messages = (_live_messages if name == LIVE else _bare_messages)(endpoint, keys)
    for _ in range(_FIRST_MESSAGES):
        next(messages)
    began_s, cpu_s = time.monotonic(), time.process_time()
    while (took_s := time.monotonic() - began_s) < float(lasting_s):
        next(messages)
    print(f"{(time.process_time() - cpu_s) / took_s:.4f}")


if __name__ == "__main__":
    main()
