"""A client's session on a live source; the test sends the frames of the source and sets the time."""

import struct
from collections.abc import Sequence

from gateway.outputs.rtc3d.live_scene import LiveScene
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters import General
from gateway.rtc3d_server.client_session import ClientSession, SessionCallbacks
from tests.unit.rtc3d_server.wire import COMMAND, EVENT, WireComponent, components_in, packets_in

_ITEM = {1: "4f", 2: "f", 3: "6f", 4: "8f", EVENT: "iqiii"}
Kinds = frozenset[ComponentType]
ALL_KINDS: Kinds = frozenset(WIRE_ORDER)
SLOW, FAST = 1, 2  # the numbers of streams
TOOL_OUT_OF_VIEW = bytes.fromhex("00000038 00000004 00000007 0000000000002710 00000001" + "ff" * 32)


def component(
    kind: int, number: int, timestamp_us: int, items: Sequence[Sequence[float]], byte_order: ByteOrder = "big"
) -> bytes:
    """Return a component (§7.1)."""
    sign = ">" if byte_order == "big" else "<"
    data = b"".join(struct.pack(sign + _ITEM[kind], *item) for item in items)
    return struct.pack(sign + "IIiqI", 24 + len(data), kind, number, timestamp_us, len(items)) + data


def body(*components: bytes, byte_order: ByteOrder = "big") -> bytes:
    """Return the body of a data frame."""
    return struct.pack((">" if byte_order == "big" else "<") + "I", len(components)) + b"".join(components)


def markers(number: int, timestamp_us: int, byte_order: ByteOrder = "big") -> bytes:
    return component(1, number, timestamp_us, [(number, 2, 3, 0.5)], byte_order)


def analog(number: int, timestamp_us: int, byte_order: ByteOrder = "big") -> bytes:
    return component(2, number, timestamp_us, [(number,), (-1.5,)], byte_order)


def event(number: int, timestamp_us: int, event_id: int) -> bytes:
    return component(EVENT, number, timestamp_us, [(event_id, timestamp_us, -1, -1, -1)])


def frame_of_markers(number: int, *others: bytes) -> bytes:
    """Return the body of frame ``number`` of 100 Hz."""
    return body(markers(number, 10_000 * number), *others)


def event_of(number: int) -> bytes:
    return event(number, 10_000 * number, number)


class LiveSource:
    """A live source with clients; time passes only by ``wait``."""

    def __init__(self, *, played: int = 0, fast_first: bool = False) -> None:
        self.scene = LiveScene("lab")
        self.scene._arrivals.began_us = -1_000_000_000  # frames do not wait until rates are known
        self.now_us = 0
        self._clients: list[LiveClient] = []
        self.scene.start()
        self.play(1, played, fast_first=fast_first)

    def client(self, *commands: str) -> "LiveClient":
        self._clients.append(LiveClient(self))
        for command in commands:
            self._clients[-1].send(command)
        return self._clients[-1]

    def play(self, first: int, last: int, *, fast_first: bool = False, base_us: int = 0) -> None:
        """Let frames of 100 Hz markers and 1000 Hz analog arrive on two streams."""
        for number in range(first, last + 1):
            timestamp_us = base_us + 10_000 * number
            slow = (body(markers(number, timestamp_us), event(number, timestamp_us, number)), SLOW)
            fast = (body(analog(10 * number, timestamp_us)), FAST)
            for each in (fast, slow) if fast_first else (slow, fast):
                self.arrive(*each)
            for step in range(1, 10):
                self.wait(1000)
                self.arrive(body(analog(10 * number + step, timestamp_us + 1000 * step)), FAST)
            self.wait(1000)

    def arrive(
        self, frame: bytes, stream: int = SLOW, byte_order: ByteOrder = "big", wanted: Kinds = ALL_KINDS
    ) -> None:
        """Let a frame arrive, and send what is due then."""
        self.scene.add(split_frame(frame, byte_order), stream, wanted, self.now_us)
        self.send()

    def wait(self, us: int) -> None:
        """Let time pass; send what is due when the scene says so."""
        until_us = self.now_us + us
        while (due_us := self.scene.advance(self.now_us)) is not None and due_us <= until_us:
            self.now_us = max(due_us, self.now_us)
            self.send()
        self.now_us = until_us
        self.send()

    def send(self) -> None:
        elapsed_us = max(self.now_us, self.scene.newest_us)
        self.scene.advance(elapsed_us)
        for client in self._clients:
            client.bodies += [packet.packet[8:] for packet in client.session.due_frames(elapsed_us)]


class LiveClient:
    """One client; ``bodies`` are the bodies of the frames that it got."""

    def __init__(self, source: LiveSource) -> None:
        self.bodies: list[bytes] = []
        self.session = ClientSession(
            SessionCallbacks(
                source.scene.frames,
                lambda sections: source.scene.parameters_xml(sections, General()),
                lambda: max(source.now_us, source.scene.newest_us),
            )
        )
        self._source = source

    def send(self, text: str) -> list[tuple[int, bytes]]:
        replies = packets_in(b"".join(self.session.answer(Packet(COMMAND, text.encode()))))
        self._source.send()
        return replies

    def take(self, byte_order: ByteOrder = "big") -> list[list[WireComponent]]:
        """Return the frames that have come since the last call."""
        bodies, self.bodies = self.bodies, []
        return [components_in(each, byte_order) for each in bodies]

    def event_ids(self) -> list[list[int]]:
        """Return the ids of the events in each of these frames."""
        return [[int(item[0]) for c in frame if c.type == EVENT for item in c.items] for frame in self.take()]

    def numbers(self) -> list[list[int]]:
        """Return the frame numbers of the components of each of these frames."""
        return [[each.frame_number for each in frame] for frame in self.take()]
