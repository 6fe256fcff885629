"""The output for ROS 2, a router that comes and goes, and peers that subscribe to /tf as ROS nodes do."""

import json
import signal
import subprocess
import sys
from typing import ClassVar

import zenoh

from gateway.outputs.adapters.ros2.output import Ros2Output
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.contract import Output
from tests.contract.frame_rigs import FrameRig, Received
from tests.support import ros_messages as ros
from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys

STALLED = """
import sys, zenoh

session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
session.declare_subscriber("0/**", lambda _: print("received", flush=True))
print("ready", flush=True)
sys.stdin.read()
"""


class Rig(FrameRig):
    """The children of transforms begin with the name of their source."""

    remedies: ClassVar[tuple[str, ...]] = ("rmw_zenohd",)
    has_router: ClassVar[bool] = True

    def __init__(self) -> None:
        self._endpoint = free_endpoint()
        self._router: zenoh.Session | None = None
        self._nodes: list[zenoh.Session] = []
        self._stalled: list[subprocess.Popen[bytes]] = []
        self._received: list[Received] = []
        self.restore()
        self.output = self.create()

    def create(self) -> Output:
        return Ros2Output(Ros2Settings(enabled=True, connect=self._endpoint))

    def subscribe(self) -> None:
        node = open_zenoh("client", connect=self._endpoint)
        self._nodes.append(node)
        node.declare_subscriber("0/tf/**", self._on_transforms)

    def _on_transforms(self, sample: zenoh.Sample) -> None:
        message = ros.decoded(sample.payload.to_bytes(), "tf2_msgs/msg/TFMessage")
        self._received += [
            (each.child_frame_id.partition("/")[0], each.transform.translation.x)
            for each in message.transforms
        ]

    def unsubscribe(self) -> None:
        while self._nodes:
            self._nodes.pop().close()

    def stall(self) -> None:
        keys = json.dumps(zenoh_keys("client", connect=self._endpoint))
        process = subprocess.Popen(
            [sys.executable, "-c", STALLED, keys], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._stalled.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGSTOP)

    def cut(self) -> None:
        assert self._router is not None
        self._router.close()
        self._router = None

    def restore(self) -> None:
        self._router = open_zenoh("router", listen=self._endpoint)

    def close(self) -> None:
        for process in self._stalled:
            process.kill()
            process.communicate()
        self.unsubscribe()
        if self._router is not None:
            self._router.close()
