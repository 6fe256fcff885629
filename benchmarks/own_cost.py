"""The gateway's own CPU time per five-component frame, from received bytes to messages.

For comparison, it also measures lcm-gen's decoding and encoding of the same messages. pyperf measures the
variants alternately, in processes of their own. To measure one: python -m benchmarks.own_cost frame_per_read
"""

import asyncio
import functools
import statistics
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import uvloop

from benchmarks.processes import PLAIN_PYTHON, run_measured
from benchmarks.report import Goal, Pair, Progress, Table, table_cell
from benchmarks.workloads import DENSE, Frames
from gateway.config.settings import HistorySettings, MetricsSettings, SourceSettings, StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.session.session import Session
from gateway.session.state import StreamState
from gateway.simulator.simulator import Simulator
from tests.support.configurations import make_settings
from tests.support.memory_output import MemoryOutput
from tests.support.waiting import wait_until_async

TITLE: Final = "The gateway's own CPU time per frame of five components, from received bytes to messages"
GATEWAY: Final = "frame_per_read"
BATCH: Final = "frames_in_one_read"
SEGMENTS: Final = "frame_in_two_reads"
PLAIN: Final = "plain_python"
RECORDING: Final = "recording"
LCM_GEN: Final = "lcm_gen"
GOAL_US: Final = 1.7
GOAL_TIMES: Final = 40.0
GOAL_RECORDING_US: Final = 5.0
_BATCH_FRAMES: Final = 64
_SEGMENT_BYTES: Final = 1448
"""The payload of a TCP segment on Ethernet; a frame has 2252 bytes."""

_BLOCK_FRAMES: Final = 64 * 16
_WRITTEN_FRAMES: Final = 128
"""How many frames are recorded before they are written, as in 0.1 s of about 1000 Hz."""

_LOOPS: Final = {
    GATEWAY: _BLOCK_FRAMES * 16,
    BATCH: _BLOCK_FRAMES * 16,
    SEGMENTS: _BLOCK_FRAMES * 16,
    PLAIN: _BLOCK_FRAMES * 16,
    RECORDING: _BLOCK_FRAMES * 16,
    LCM_GEN: 1000,
}
_TEXTS: Final = {
    GATEWAY: "gateway, one frame per read",
    BATCH: f"gateway, {_BATCH_FRAMES} frames per read",
    SEGMENTS: "gateway, each frame in two reads, split like TCP segments on Ethernet",
    PLAIN: "gateway not compiled, one frame per read",
    RECORDING: "gateway, one frame per read, recording a take, including the thread that writes",
    LCM_GEN: "lcm-gen: decode and encode the same five messages",
}


class _StoringPublisher:
    """A publisher that only stores the newest message, at the least possible cost."""

    wanted = True

    def __init__(self) -> None:
        self.messages: deque[bytes] = deque(maxlen=1)
        self.publish = self.messages.append

    def close(self) -> None:
        pass


class _StoringOutput(MemoryOutput):
    """An output whose publishers only store messages, so that all other cost is the gateway's own."""

    def __init__(self) -> None:
        super().__init__()
        self.publishers: dict[tuple[str, ...], _StoringPublisher] = {}

    def publisher(self, topic: Topic) -> Any:
        return self.publishers.setdefault(topic.path, _StoringPublisher())


class FedGateway:
    """A running gateway, connected to a silent server. ``run`` passes frames to its session directly.

    With ``records``, a take is running, and ``run`` includes the time of the thread that writes it.
    ``history`` is whether messages are kept for subscribers that miss some.
    """

    def __init__(self, *, records: bool = False, history: bool = True) -> None:
        self._history = HistorySettings() if history else HistorySettings(seconds=0)
        self._folder = tempfile.TemporaryDirectory()
        settings = TakesSettings(enabled=True, directory=self._folder.name)
        self._takes = TakesOutput(settings) if records else None
        self._loop = uvloop.new_event_loop()
        self._output = _StoringOutput()
        self._frames = Frames(DENSE.packet(), _BLOCK_FRAMES)
        self._number = 1
        self._session = self._loop.run_until_complete(self._connect())

    async def _connect(self) -> Session:
        self._server = Simulator(DENSE.scene())
        await self._server.start()
        self._server.stop_measurement()
        # With backlog: all, a read of 64 frames would be published at a pace, by timers. With latest and
        # such a max_lag_ms, all frames of a read are published at once.
        source = SourceSettings(
            name="lab",
            host="127.0.0.1",
            port=self._server.port,
            max_lag_ms=60_000.0,
            streams=(StreamSettings(backlog="latest"),),
        )
        self._stop = asyncio.Event()
        outputs = [self._output] if self._takes is None else [self._output, self._takes]
        settings = make_settings(
            sources=(source,), metrics=MetricsSettings(enabled=False), history=self._history
        )
        gateway = Gateway(settings, outputs)
        self._running = self._loop.create_task(gateway.run(self._stop))
        [source_gateway] = gateway.sources
        [stream] = source_gateway.streams
        await wait_until_async(
            lambda: stream.session is not None and stream.status.state is StreamState.NO_MEASUREMENT
        )
        session = stream.session
        assert session is not None  # noqa: S101 - that was waited for
        if self._takes is not None:
            await self._takes.takes("lab").start()
        return session

    def run(self, loops: int, per_read: int, *, segments: bool = False) -> float:
        """Pass ``loops`` frames to the session and return the CPU time in s.

        Each read has ``per_read`` frames. With ``segments``, each read is split in two.
        """
        return self._loop.run_until_complete(self._feed(loops, per_read, segments=segments))

    async def _feed(self, loops: int, per_read: int, *, segments: bool) -> float:
        size = self._frames.packet_bytes
        feed = self._session.data_received
        took_s = 0.0
        for first in range(0, loops, _BLOCK_FRAMES):
            self._frames.stamp(self._number, time.monotonic_ns() // 1000)
            self._number += _BLOCK_FRAMES
            data = bytes(self._frames.data[: min(_BLOCK_FRAMES, loops - first) * size])
            reads = [data[at : at + per_read * size] for at in range(0, len(data), per_read * size)]
            if segments:
                cuts = (slice(_SEGMENT_BYTES), slice(_SEGMENT_BYTES, None))
                reads = [read[cut] for read in reads for cut in cuts]
            began_s = time.process_time()
            for number, read in enumerate(reads):
                feed(read)
                if self._takes is not None and number % _WRITTEN_FRAMES == 0:
                    await self._takes.storage.written()
            took_s += time.process_time() - began_s
        return took_s

    def messages(self) -> list[bytes]:
        """Return the newest message of each component."""
        self.run(1, 1)
        return [
            publisher.messages[0]
            for path, publisher in self._output.publishers.items()
            if path[0] not in {"status", "clock"}
        ]

    def close(self) -> None:
        """Stop the gateway and the server."""
        self._stop.set()
        self._loop.run_until_complete(self._running)
        self._loop.run_until_complete(self._server.close())
        self._folder.cleanup()


def decode_and_encode(messages: Sequence[bytes], loops: int) -> float:
    """Have lcm-gen's code decode and encode these messages ``loops`` times; return the CPU time in s."""
    decoded = [(message, type(decode(message))) for message in messages]
    began_s = time.process_time()
    for _ in range(loops):
        for message, message_type in decoded:
            message_type.decode(message).encode()
    return time.process_time() - began_s


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return 20 if quick else 230


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the CPU time per frame of each variant, in µs."""
    import pyperf  # noqa: PLC0415 - not needed by the tests

    values: dict[str, list[float]] = {name: [] for name in _LOOPS}
    rounds = 2 if quick else 15
    sizes = ["--processes=1", "--warmups=1", "--values=2" if quick else "--values=5"]
    sizes.append("--inherit-environ=PYTHONPATH,PYTHONSAFEPATH")
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            progress.step(f"round {number + 1} of {rounds}", number / rounds)
            for name, each in values.items():
                file = Path(folder) / f"{name}-{number}.json"
                command = [sys.executable, "-m", "benchmarks.own_cost", name, "--output", str(file)]
                environment = PLAIN_PYTHON if name == PLAIN else None
                run_measured([*command, *sizes, f"--loops={_LOOPS[name]}"], environment)
                each.append(1e6 * pyperf.Benchmark.load(str(file)).median())
    return {"cpu_us_per_frame": {name: [float(f"{x:.4g}") for x in each] for name, each in values.items()}}


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    values = result["cpu_us_per_frame"]
    rows = []
    for name, text in _measured(values).items():
        ratio = "" if name == LCM_GEN else table_cell(_compared_with_lcm_gen(values, name))
        rows.append([text, f"{statistics.median(values[name]):.2f}", ratio])
    return [Table(TITLE, ["what", "CPU µs per frame", "lcm-gen takes this many times as long"], rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the CPU time per frame, absolute and compared with lcm-gen's."""
    values = result["cpu_us_per_frame"]
    cost_us = statistics.median(values[GATEWAY])
    times, times_batch = (_compared_with_lcm_gen(values, name).ratio for name in (GATEWAY, BATCH))
    return [
        Goal(
            "own cost per five-component frame",
            f"at most {GOAL_US:g} µs",
            f"{cost_us:.1f} µs",
            cost_us <= GOAL_US,
        ),
        Goal(
            "own cost, compared with lcm-gen's decode and encode",
            f"at least {GOAL_TIMES:g} times less",
            f"{times:.0f} times less with one frame per read, {times_batch:.0f} with {_BATCH_FRAMES}",
            times >= GOAL_TIMES,
        ),
        *_recording_goals(values),
    ]


def _measured(values: dict[str, list[float]]) -> dict[str, str]:
    """Return the texts of the variants in a result; an older one has no recording."""
    return {name: text for name, text in _TEXTS.items() if name in values}


def _recording_goals(values: dict[str, list[float]]) -> list[Goal]:
    if RECORDING not in values:
        return []
    added_us = statistics.median(values[RECORDING]) - statistics.median(values[GATEWAY])
    return [
        Goal(
            "cost of recording a five-component frame, on top",
            f"at most {GOAL_RECORDING_US:g} µs",
            f"{added_us:.1f} µs",
            added_us <= GOAL_RECORDING_US,
        )
    ]


def _compared_with_lcm_gen(values: dict[str, list[float]], name: str) -> Pair:
    return Pair.of({LCM_GEN: values[LCM_GEN], name: values[name]})


def main() -> None:
    """Measure one variant with pyperf, which calls this in each of its worker processes."""
    import pyperf  # noqa: PLC0415 - as above

    name = sys.argv.pop(1)
    fed = functools.cache(lambda: FedGateway(records=name == RECORDING))
    messages = functools.cache(lambda: fed().messages())

    def feed(loops: int) -> float:
        return fed().run(loops, _BATCH_FRAMES if name == BATCH else 1, segments=name == SEGMENTS)

    def lcm_gen(loops: int) -> float:
        return decode_and_encode(messages(), loops)

    def pass_name_on(command: list[str], _: object) -> None:
        command.insert(command.index("benchmarks.own_cost") + 1, name)

    runner = pyperf.Runner(add_cmdline_args=pass_name_on, program_args=("-m", "benchmarks.own_cost"))
    runner.bench_time_func(name, lcm_gen if name == LCM_GEN else feed)
    if fed.cache_info().currsize:
        fed().close()


if __name__ == "__main__":
    main()
