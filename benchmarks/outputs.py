"""What each output costs: the gateway's CPU time per frame, with nobody and with one peer.

Each output has a gateway of its own, which publishes on nothing else. The bare relay to Zenoh is measured
beside them. All are measured one after the other, again and again, so that a slow phase of the machine
concerns all of them.
"""

import contextlib
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np

from benchmarks import output_peers, processes
from benchmarks.processes import Program, Worker, zenoh_session_config
from benchmarks.report import Goal, Pair, Progress, Table, table_cell
from benchmarks.workbench import lcm_url, relay_cuts
from benchmarks.workloads import DENSE, Paced, send
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import MESSAGE_TYPES, Stamp
from gateway.messages.ros2.encode import TF_MESSAGE
from gateway.outputs.adapters.ros2.latched import StaticTransforms
from gateway.outputs.adapters.ros2.source import RosSource
from gateway.outputs.adapters.ros2.topic import Declared, RosTopic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.confirmation import SentMessages
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from tests.support.lsl_receiver import lsl_config
from tests.support.networks import free_port

TITLE: Final = "CPU time per frame of five components at 1000 Hz, by output"
RELAY: Final = "relay"
_SOURCE: Final = "lab"
_FIRST_FRAMES: Final = 300
_LCM_PORT: Final = 7690

_TEXTS: Final = {
    RELAY: "the bare relay, to Zenoh",
    "zenoh": "Zenoh",
    "lcm": "LCM",
    "ros2": "ROS 2",
    "rtc3d": "RTC3D",
    "vrpn": "VRPN",
    "lsl": "LSL",
    "foxglove": "Foxglove",
}
_NOTE: Final = (
    "The whole process, with its libraries' threads and its children. LCM sends without a peer, too. "
    "ROS 2 makes one message for each of 10 tools, and one for each event and plate; the relay makes five in "
    "all."
)

ROS2_POSES: Final = "ros2_poses_us"
GOAL_ROS2_POSES_US: Final = 30.0


class Endpoints(NamedTuple):
    """Where an output and its peer meet: a port, the endpoint of a router, and a folder for files."""

    port: int
    router: str
    folder: Path


class _Case(NamedTuple):
    """How to measure an output: its section in the configuration, and its peer."""

    settings: Callable[[Endpoints], dict[str, Any]]
    peer: Callable[[Endpoints], Worker]
    num_topics: int = 1
    """How many topics the peer receives, as it counts them."""


def _endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


def _lsl_config(at: Endpoints) -> Path:
    """Return the configuration that the gateway and its peer share, as docs/how-to/lsl.md recommends it."""
    file = at.folder / "lsl_api.cfg"
    return file if file.exists() else lsl_config(at.folder)


def _zenoh_peer(endpoint: str, keys: str) -> Worker:
    config = zenoh_session_config("client", connect=[endpoint])
    return Worker(output_peers.zenoh_peer, config, keys)


CASES: Final = {
    "zenoh": _Case(
        lambda at: {"config": zenoh_session_config("peer", listen=[_endpoint(at.port)])},
        lambda at: _zenoh_peer(_endpoint(at.port), f"mocap/{_SOURCE}/*"),
        len(MESSAGE_TYPES),
    ),
    "lcm": _Case(
        lambda _: {"url": lcm_url(_LCM_PORT)},
        lambda _: Worker(output_peers.lcm_peer, lcm_url(_LCM_PORT)),
        len(MESSAGE_TYPES),
    ),
    "ros2": _Case(
        lambda at: {"connect": at.router},
        lambda at: _zenoh_peer(at.router, "0/**"),
        DENSE.plates + 3,  # wrenches, markers, analog and /tf; each tool in view has a topic, too
    ),
    "rtc3d": _Case(
        lambda at: {"ports": {_SOURCE: at.port}},
        lambda at: Worker(output_peers.rtc3d_peer, at.port),
    ),
    "vrpn": _Case(
        lambda at: {"port": at.port},
        lambda at: Worker(output_peers.vrpn_peer, at.port),
    ),
    "lsl": _Case(
        lambda at: {"config": str(_lsl_config(at))},
        lambda at: Worker(output_peers.lsl_peer, _lsl_config(at), len(MESSAGE_TYPES)),
        len(MESSAGE_TYPES),
    ),
    "foxglove": _Case(
        lambda at: {"port": at.port},
        lambda at: Worker(output_peers.foxglove_peer, at.port),
    ),
}


def _names() -> list[str]:
    return [name for name in OUTPUTS if name in CASES]


class Bench:
    """A context in which a gateway for each output runs, and the relay. ``connect_peers`` comes later."""

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            self._endpoints: dict[str, Endpoints] = {}
            self._router = _endpoint(free_port())
            config = processes.router_config([self._router])
            stack.enter_context(processes.router(folder / "router.json5", config))
            self.sender = stack.enter_context(Worker(send, DENSE, [RELAY, *_names()]))
            self.programs: dict[str, Program] = {}
            self.peers: dict[str, Worker] = {}
            for name in (RELAY, *_names()):
                program = self._program(name, folder / name)
                self.programs[name] = stack.enter_context(program)
            for name in self.programs:
                self.cost_us(name, _FIRST_FRAMES)  # once they are ready
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _program(self, name: str, folder: Path) -> Program:
        folder.mkdir()
        at = self._endpoints[name] = Endpoints(free_port(), self._router, folder)
        port = self.sender.started[name]
        if name == RELAY:
            config = zenoh_session_config("peer", listen=[_endpoint(at.port)])
            plan = {"name": _SOURCE, "port": port, "zenoh": config, "lcm": None}
            return processes.relay({**plan, "cuts": relay_cuts(DENSE)})
        settings: dict[str, Any] = {
            "sources": [processes.source(_SOURCE, port)],
            "metrics": {"port": free_port()},
            **{each: {"enabled": False} for each in OUTPUTS},
            name: {"enabled": True, **CASES[name].settings(at)},
        }
        return processes.gateway(folder / "gateway.yaml", settings)

    def connect_peers(self) -> None:
        """Connect one peer to each output, and wait until it receives every topic."""
        for name in self.programs:
            case = CASES["zenoh" if name == RELAY else name]
            self.peers[name] = self._stack.enter_context(case.peer(self._endpoints[name]))
            processes.wait_until(partial(self._receives, name, case.num_topics), f"{name}'s peer receives")

    def _receives(self, name: str, num_topics: int) -> bool:
        self.cost_us(name, _FIRST_FRAMES)
        return len(self.peers[name].ask("count")) >= num_topics

    def cost_us(self, name: str, frames: int) -> float:
        """Send frames at 1000 Hz; return the CPU time of the program and its children per frame, in µs."""
        program = self.programs[name]
        before_s = processes.tree_cpu_s(program.pid)
        self.sender.ask(Paced(name, frames, DENSE.rate_hz))
        return 1e6 * (processes.tree_cpu_s(program.pid) - before_s) / frames


def _plan(quick: bool) -> tuple[int, int]:
    """Return the number of rounds, and of frames in each."""
    return (2, 300) if quick else (7, 1000)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, frames = _plan(quick)
    return (len(_names()) + 1) * (2 * rounds * frames / DENSE.rate_hz + 3)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the CPU times per frame of each output, without and with a peer, in µs."""
    rounds, frames = _plan(quick)
    costs: dict[str, dict[str, list[float]]] = {}
    with Bench() as bench:
        for number, peers in enumerate(("nobody", "one peer")):
            progress.step("connecting peers" if number else "starting", number / 2)
            if number:
                bench.connect_peers()
            costs[peers] = {name: [] for name in bench.programs}
            for each in range(rounds):
                progress.step(f"{peers}, round {each + 1} of {rounds}", (number + each / rounds) / 2)
                for name, values in costs[peers].items():
                    values.append(float(f"{bench.cost_us(name, frames):.5g}"))
    return {"cpu_us_per_frame": costs, **_ros2_poses()}


def _ros2_poses() -> dict[str, float]:
    if "ros2" not in OUTPUTS:
        return {}
    command = [sys.executable, "-m", "benchmarks.outputs"]
    return {ROS2_POSES: float(processes.run_measured(command))}


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    without, with_peer = result["cpu_us_per_frame"].values()
    rows = []
    for name, costs in with_peer.items():
        pair = Pair.of({name: costs, RELAY: with_peer[RELAY]}) if name != RELAY else None
        rows.append(
            [
                _TEXTS[name],
                f"{statistics.median(without[name]):.0f}",
                f"{statistics.median(costs):.0f}",
                "" if pair is None else table_cell(pair),
            ]
        )
    return [Table(TITLE, ["output", "nobody, µs", "one peer, µs", "times the relay's cost"], rows, _NOTE)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the cost of poses for ROS 2, if it was measured."""
    if ROS2_POSES not in result:
        return []
    cost_us = result[ROS2_POSES]
    return [
        Goal(
            "own code for ROS 2, a frame of 6 poses and tf",
            f"at most {GOAL_ROS2_POSES_US:g} µs",
            f"{cost_us:.1f} µs",
            cost_us <= GOAL_ROS2_POSES_US,
        )
    ]


_TOOLS: Final = 6
_POSE_ROUNDS: Final = 9
_POSE_FRAMES: Final = 3000


class _SilentNetwork:
    """Stands for Zenoh: everybody subscribes to everything, and nothing is sent."""

    is_cut_off = False

    def declare(self, _topic: RosTopic, on_matching: Callable[[bool], None]) -> Declared:
        on_matching(True)
        publisher: Any = self
        return Declared(publisher, publisher, bytes(16))

    def put(self, message: bytes, *, attachment: bytes) -> None:
        """Send nothing."""

    def offer(self, call: Callable[[], None], _num_bytes: int = 0) -> bool:
        """Make the call at once, not in another thread."""
        call()
        return True

    def submit(self, call: Callable[[], None]) -> None:
        """Make the call at once."""
        call()


def main() -> None:
    """Print the CPU time in µs of the output ros2's own code for a frame of 6 tools: six poses and /tf.

    That is handing the frame over, encoding, and the attachments, without Zenoh's part.
    """
    network: Any = _SilentNetwork()
    tf = RosTopic("/tf", TF_MESSAGE, lambda: None)
    tf.declare(network)
    static = StaticTransforms(lambda: None)
    source = RosSource("lab", "/mocap/lab", tf, static, {}, network, network, SentMessages())
    tools = Parameters6D(tools=tuple(Tool(str(number), f"Tool {number}") for number in range(_TOOLS)))
    frame = CoordinateFrame("lab", 1e-3, (0.0, 0.0, 0.6, 0.8), (1.0, 2.0, 3.0))
    source.set_parameters(ServerParameters(b"", 1, 1, parsed=Parameters(tools=tools), frame=frame))
    source.declare(network)
    items = np.array(
        [(1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.1)] * _TOOLS, ITEM_DTYPES[ComponentType.TOOLS]
    )
    data = split_frame(encode_frame([encode_component(ComponentType.TOOLS, 1, 1000, items)]), "big")
    stamp = Stamp(1_800_000_000_000_000, 1_800_000_000_000_000, 1, 1)
    components = frozenset({ComponentType.TOOLS})
    costs_us = []
    for _ in range(_POSE_ROUNDS):
        begun_s = time.thread_time()
        for _ in range(_POSE_FRAMES):
            source.publish(data, stamp, components)
        costs_us.append((time.thread_time() - begun_s) / _POSE_FRAMES * 1e6)
    print(f"{statistics.median(costs_us):.1f}")


if __name__ == "__main__":
    main()
