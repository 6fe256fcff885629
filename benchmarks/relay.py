"""The bare relay: it publishes what arrives on a TCP connection without decoding it.

From each packet it cuts as many bytes as the gateway's messages have, and passes them to the same calls.
Whatever the gateway costs beyond that is its own cost.
"""

import asyncio
import json
import sys
from functools import partial
from typing import Any

import lcm
import uvloop
import zenoh

from gateway.messages.decode import LCM
from gateway.outputs.zenoh.config import zenoh_config


class Relay(asyncio.Protocol):
    """One connection; ``cuts`` are (first byte, end, functions that publish the bytes between)."""

    def __init__(self, cuts: list[tuple[int, int, list[Any]]], ended: asyncio.Event) -> None:
        self.cuts, self.ended = cuts, ended
        self.lead = -cuts[0][0]  # the first message begins so many bytes before its packet
        self.unread = bytes(self.lead)

    def connection_made(self, transport: Any) -> None:  # noqa: D102
        transport.write(b"\0\0\0\x1e\0\0\0\x01StreamFrames AllFrames")

    def data_received(self, data: bytes) -> None:  # noqa: D102
        data = self.unread + data
        at, end = self.lead, len(data)
        while end - at >= 8 and end - at >= (size := int.from_bytes(data[at : at + 4])):
            if data[at + 7] == 3:
                for first, last, sends in self.cuts:
                    message = data[at + first : at + last]
                    for send in sends:
                        send(message)
            at += size
        self.unread = data[at - self.lead :]

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002, D102
        self.ended.set()


async def main(plan: dict[str, Any]) -> None:
    """Connect, and reconnect after every connection, until the process is ended."""
    session = zenoh.open(zenoh_config(plan["zenoh"])) if plan["zenoh"] else None
    channels = lcm.LCM(plan["lcm"]) if plan["lcm"] else None
    cuts: list[tuple[int, int, list[Any]]] = []
    for first, last, component, schema in plan["cuts"]:
        sends: list[Any] = []
        if session:
            key = f"mocap/{plan['name']}/{component}"
            encoding, drop = zenoh.Encoding(LCM).with_schema(schema), zenoh.CongestionControl.DROP
            sends.append(session.declare_publisher(key, encoding=encoding, congestion_control=drop).put)
        if channels:
            sends.append(partial(channels.publish, f"MOCAP_{plan['name']}_{component}".upper()))
        cuts.append((first, last, sends))
    loop = asyncio.get_running_loop()
    while True:
        ended = asyncio.Event()
        await loop.create_connection(partial(Relay, cuts, ended), "127.0.0.1", plan["port"])
        await ended.wait()


if __name__ == "__main__":
    uvloop.run(main(json.loads(sys.argv[1])))
