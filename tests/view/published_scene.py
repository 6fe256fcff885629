"""A source on Zenoh whose messages a test chooses."""

import itertools
import json
import math
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import rtc3d
import zenoh

from gateway.client.sources import FINGERPRINTS
from gateway.messages.encode import PREFIX
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.queried_gateway import parameters_xml

Position = tuple[float, float, float]

MISSING: Final[Position] = (math.nan, math.nan, math.nan)

PERIOD_S: Final = 0.01


class PublishedScene:
    """Publishes what it holds as the source ``name``, 100 times a second, in a thread of its own.

    A test may change the scene at any time.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, name: str = "lab") -> None:
        self.markers: list[Position] = []
        """In mm."""
        self.is_blinking = False
        """Whether the last marker is missing in all frames but every tenth."""
        self.is_sending = True
        """Whether frames are published; the status always is."""
        self.endpoint = endpoint
        """Where a subscriber connects to."""
        self.session = session
        self._name = name
        self._version = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        """Begin to publish."""
        self._token = self.session.liveliness().declare_token(f"mocap/{self._name}/alive")
        self._thread.start()

    def stop(self) -> None:
        """End publishing."""
        self._stop.set()
        self._thread.join()
        self._token.undeclare()

    def name_markers(self, *labels: str) -> None:
        """Publish parameters with these labels."""
        self._version += 1
        self._xml = parameters_xml(*labels)
        self._publish_parameters()

    def _publish_parameters(self) -> None:
        facts = {"session": 1, "parameters_version": self._version, "age_s": 0.0}
        self.session.put(f"mocap/{self._name}/parameters", self._xml, attachment=json.dumps(facts))

    def _run(self) -> None:
        for number in itertools.count():
            if self.is_sending:
                self._put("3d", self._frame(number))
            if number % 100 == 0:
                self._put("status", self._status().encode())
                if self._version:
                    self._publish_parameters()
            if self._stop.wait(PERIOD_S):
                return

    def _put(self, key: str, message: bytes) -> None:
        self.session.put(f"mocap/{self._name}/{key}", message)

    def _frame(self, number: int) -> bytes:
        items = np.zeros(len(self.markers), ITEM_DTYPES[ComponentType.MARKERS])
        positions = np.array(self.markers, float).reshape(-1, 3)
        if self.is_blinking and number % 10:
            positions[-1] = MISSING
        items["x"], items["y"], items["z"] = positions.T
        now = now_utime()
        prefix = PREFIX.pack(now, now, number, 1, self._version)
        head = struct.pack(">iqi", number, round(number * PERIOD_S * 1e6), len(items))
        return FINGERPRINTS["3d"] + prefix + head + items.tobytes()

    def _status(self) -> Any:
        message = rtc3d.status_t()
        message.utime = message.capture_utime = now_utime()
        message.source = self._name
        stream = rtc3d.stream_status_t()
        stream.components = "all"
        stream.state = "streaming"
        stream.frame_rate_hz = 1 / PERIOD_S
        message.streams = [stream]
        message.num_streams = 1
        return message


@contextmanager
def published_scene(markers: Sequence[Position]) -> Iterator[PublishedScene]:
    """Publish a scene during the block."""
    endpoint = free_endpoint()
    session = open_zenoh("router", listen=endpoint)
    scene = PublishedScene(session, endpoint)
    scene.markers = list(markers)
    scene.start()
    try:
        yield scene
    finally:
        scene.stop()
        session.close()
