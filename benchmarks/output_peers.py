"""One peer for each output: it receives everything that the output sends, at as little cost as possible.

Each runs in a Worker and answers every request with what it has received so far: a number of messages, or of
bytes, by topic. So a topic that is missing is noticed.
"""

import importlib
import json
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, Final

from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.packets import PacketType, encode_packet

Peer = Generator[Counter[str] | None, Any, None]

_VRPN_COOKIE: Final = b"vrpn: ver. 07.35  0".ljust(24, b"\0")
_READ_BYTES: Final = 1 << 20
_POLL_S: Final = 0.02
_MAX_SAMPLES: Final = 4096
_KEPT: Final = 1000


def zenoh_peer(config: dict[str, Any], keys: str) -> Peer:
    """Subscribe to ``keys`` on Zenoh, whose own threads receive."""
    import zenoh  # noqa: PLC0415 - only this process opens a session

    received: Counter[str] = Counter()
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        subscriber: Any = session.declare_subscriber(keys, zenoh.handlers.RingChannel(_KEPT))
        yield None
        while True:
            while (sample := subscriber.handler.try_recv()) is not None:
                received[str(sample.key_expr)] += 1
            yield received


def lcm_peer(url: str) -> Peer:
    """Subscribe to all channels of ``url``. LCM's thread receives, and its queue drops messages."""
    import lcm  # noqa: PLC0415 - only this process subscribes

    received: Counter[str] = Counter()
    connection = lcm.LCM(f"{url}&recv_buf_size=4000000")
    connection.subscribe(".*", lambda channel, _: received.update([channel]))
    yield None
    while True:
        while connection.handle_timeout(0):
            pass
        yield received


def rtc3d_peer(port: int) -> Peer:
    """Stream all frames like an RTC3D client."""
    command = encode_packet(PacketType.COMMAND, str(StreamFrames()).encode())

    def connected() -> socket.socket:
        connection = _connect(port)
        connection.sendall(command)
        return connection

    return _reading(connected)


def vrpn_peer(port: int) -> Peer:
    """Connect like a VRPN client, which receives the reports of all trackers."""

    def connected() -> socket.socket:
        connection = _connect(port)
        connection.sendall(_VRPN_COOKIE)
        return connection

    return _reading(connected)


def foxglove_peer(port: int) -> Peer:
    """Subscribe to all channels like Foxglove."""
    from websockets.client import ClientProtocol  # noqa: PLC0415 - only this process needs it
    from websockets.typing import Subprotocol  # noqa: PLC0415
    from websockets.uri import parse_uri  # noqa: PLC0415

    uri = parse_uri(f"ws://127.0.0.1:{port}")
    protocol = ClientProtocol(uri, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None)

    def connected() -> socket.socket:
        connection = _connect(port)
        protocol.send_request(protocol.connect())
        channels: list[int] = []
        while not channels:
            connection.sendall(b"".join(protocol.data_to_send()))
            protocol.receive_data(connection.recv(_READ_BYTES))
            for event in protocol.events_received():
                data = getattr(event, "data", b"")
                message = json.loads(data) if data[:1] == b"{" else {}
                channels += [channel["id"] for channel in message.get("channels", ())]
        subscriptions = [{"id": each, "channelId": each} for each in channels]
        protocol.send_text(json.dumps({"op": "subscribe", "subscriptions": subscriptions}).encode())
        connection.sendall(b"".join(protocol.data_to_send()))
        return connection

    def answer(data: bytes) -> bytes:
        """Answer pings: a viewer that does not is disconnected."""
        protocol.receive_data(data)
        protocol.events_received()
        return b"".join(protocol.data_to_send())

    return _reading(connected, answer)


def lsl_peer(config: Path, streams: int) -> Peer:
    """Open an inlet for each of so many streams."""
    os.environ["LSLAPICFG"] = str(config)
    pylsl: Any = importlib.import_module("pylsl")  # it reads its configuration when it is imported

    received: Counter[str] = Counter()
    inlets: dict[str, Any] = {}

    def receive() -> None:
        while True:
            time.sleep(_POLL_S)
            for info in pylsl.resolve_streams(1.2) if len(inlets) < streams else ():
                if info.name() not in inlets:
                    inlets[info.name()] = inlet = pylsl.StreamInlet(info, recover=True)
                    inlet.open_stream(timeout=5)
            for name, inlet in inlets.items():
                received[name] += len(inlet.pull_chunk(0.0, _MAX_SAMPLES)[1])

    threading.Thread(target=receive, daemon=True).start()
    yield None
    while True:
        yield received


def _connect(port: int) -> socket.socket:
    """Return a connection as soon as the output listens."""
    deadline_s = time.monotonic() + 30
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except ConnectionRefusedError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_POLL_S)


def _reading(
    connected: Callable[[], socket.socket], answer: Callable[[bytes], bytes] = lambda _: b""
) -> Peer:
    """Read and count the bytes of a connection, and send what ``answer`` returns for them."""
    received: Counter[str] = Counter()
    connection = connected()

    def receive() -> None:
        while data := connection.recv(_READ_BYTES):
            received["bytes"] += len(data)
            if reply := answer(data):
                connection.sendall(reply)

    threading.Thread(target=receive, daemon=True).start()
    yield None
    while True:
        yield received
