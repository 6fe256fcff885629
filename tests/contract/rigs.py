"""The outputs under test, each with the network around it."""

import asyncio
import tempfile
from pathlib import Path
from typing import Protocol

import lcm
import zenoh

from gateway.messages.topics import Topic
from gateway.outputs.contract import Output
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber
from gateway.takes.files.event_log import EventLogReader
from tests.support.lcm_relay import LcmRelay
from tests.support.needs import need_programs
from tests.support.networks import (
    add_multicast_route,
    free_endpoint,
    lcm_url,
    open_zenoh,
    remove_multicast_route,
    zenoh_keys,
)
from tests.support.waiting import wait_until

MARKERS = Topic("lab", ("3d",), "rtc3d.markers_t")
ANALOG = Topic("lab", ("analog",), "rtc3d.analog_t")
PROBE = Topic("hall-2", ("6d", "Probe 1"), "rtc3d.tool_pose_t")

LCM_CHANNELS = {MARKERS: "MOCAP_LAB_3D", ANALOG: "MOCAP_LAB_ANALOG", PROBE: "MOCAP_HALL_2_6D_PROBE_1"}


class Rig(Protocol):
    """An output and the network around it, which works at first."""

    @property
    def output(self) -> Output: ...

    @property
    def names(self) -> dict[Topic, str]:
        """The key or channel of each topic."""

    @property
    def remedies(self) -> tuple[str, ...]:
        """While the network is down, the problem in ``health`` contains one of these texts."""

    @property
    def received(self) -> list[tuple[str, bytes]]:
        """The keys or channels and the messages that a subscriber received since ``subscribe``."""

    def subscribe(self) -> None:
        """Subscribe to everything that the output sends."""

    def cut(self) -> None:
        """Make the output unable to send."""

    def restore(self) -> None:
        """Make the network work again; the output has to notice by itself."""

    def close(self) -> None:
        """Close the subscriber and the network."""


class ZenohRig:
    """A client whose router comes and goes."""

    remedies = ("start zenohd", "is the router running")

    def __init__(self) -> None:
        self.names = {MARKERS: "mocap/lab/3d", ANALOG: "mocap/lab/analog", PROBE: "mocap/hall-2/6d/Probe%201"}
        self._endpoint = free_endpoint()
        self._router = open_zenoh("router", listen=self._endpoint)
        self._session: zenoh.Session | None = None
        self.received: list[tuple[str, bytes]] = []
        self.output = ZenohOutput(ZenohSettings(config=zenoh_keys("client", connect=self._endpoint)))

    def subscribe(self) -> None:
        self._session = open_zenoh("client", connect=self._endpoint)
        self._subscriber = ZenohSubscriber(
            self._session, ["mocap/**"], lambda *each: self.received.append(each)
        )

    def cut(self) -> None:
        self._router.close()

    def restore(self) -> None:
        self._router = open_zenoh("router", listen=self._endpoint)

    def close(self) -> None:
        wait_until(
            lambda: not self.output._holder._opener._thread.is_alive()
        )  # a later test would see what it logs
        if self._session is not None:
            self._session.close()
        self._router.close()


class LcmRig:
    """UDP multicast whose route comes and goes."""

    remedies = ("ip route add 224.0.0.0/4",)

    def __init__(self) -> None:
        need_programs("ip", packages="iproute2")
        self.names = LCM_CHANNELS
        self._url = lcm_url()
        self._subscriber: LcmSubscriber | None = None
        self.received: list[tuple[str, bytes]] = []
        self.output = LcmOutput(LcmSettings(url=self._url))

    def subscribe(self) -> None:
        self._subscriber = LcmSubscriber(
            lcm.LCM(self._url), "MOCAP_.*", lambda *each: self.received.append(each)
        )

    def cut(self) -> None:
        remove_multicast_route()

    def restore(self) -> None:
        add_multicast_route()

    def close(self) -> None:
        if self._subscriber is not None:
            self._subscriber.close()
        self.restore()


class TakesRig:
    """A folder that comes and goes, with a running take of each source. A file takes its place meanwhile."""

    remedies = ("choose a folder", "does its disk respond")

    def __init__(self) -> None:
        self.names = LCM_CHANNELS
        # The output may create its folder again meanwhile: ``close`` waits only briefly for the disk.
        self._parent = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._folder = Path(self._parent.name) / "takes"
        self._disk = Path(self._parent.name) / "disk"
        self._disk.mkdir()
        self.restore()
        settings = TakesSettings(enabled=True, directory=str(self._folder))
        self.output = TakesOutput(settings, max_queued_bytes=100_000)
        for topic in self.names:
            self.output.announce(topic.source)

    @property
    def received(self) -> list[tuple[str, bytes]]:
        events = [
            event for path in self._folder.glob("*/*.lcmlog") for event in EventLogReader(path).events()
        ]
        return [(event.channel, event.message) for event in events if not event.channel.endswith("_TAKE")]

    def subscribe(self) -> None:
        for source in sorted({topic.source for topic in self.names}):
            asyncio.run(self.output.takes(source).start("take"))

    def cut(self) -> None:
        file = self._folder.with_name("file")
        file.write_text("no folder")
        file.replace(self._folder)

    def restore(self) -> None:
        link = self._folder.with_name("link")
        link.symlink_to(self._disk)
        link.replace(self._folder)  # in one step, because the output creates a folder that is missing

    def close(self) -> None:
        self._parent.cleanup()


class LcmRelayRig:
    """A TCP relay that comes and goes."""

    remedies = ("check lcm.url",)

    def __init__(self) -> None:
        self.names = LCM_CHANNELS
        self._relay = LcmRelay()
        # LCM frees a lost connection only after it has connected again, and holds up this whole process
        # meanwhile. So lost subscribers stay until the relay is closed.
        self._subscribers: list[LcmSubscriber] = []
        self.received: list[tuple[str, bytes]] = []
        self.output = LcmOutput(LcmSettings(url=self._relay.url))

    def subscribe(self) -> None:
        connection = lcm.LCM(self._relay.url)
        self._subscribers.append(LcmSubscriber(connection, ".*", lambda *each: self.received.append(each)))
        wait_until(lambda: ".*" in self._relay.subscribed)

    def cut(self) -> None:
        self._relay.close()

    def restore(self) -> None:
        self._relay.open()
        if self._subscribers:
            self._subscribers[-1].close()
            self.subscribe()

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.close()
        self._relay.close()
