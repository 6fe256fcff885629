"""The ceiling: a relay that publishes what comes on a TCP connection without looking into it.

For each packet it cuts out as many bytes as the gateway's messages have, and hands them to the same calls.
"""

import asyncio
import json
import signal
import sys
from functools import partial

import lcm
import zenoh

from gateway.outputs.zenoh_output import LCM_ENCODING, zenoh_config


class Relay(asyncio.Protocol):
    def __init__(self, cuts, ended):
        self.cuts, self.ended = cuts, ended
        self.rest = bytes(16)  # a message begins up to 16 bytes before its packet: the gateway's prefix is longer

    def connection_made(self, transport):
        transport.write(b"\0\0\0\x1e\0\0\0\x01StreamFrames AllFrames")

    def data_received(self, data):
        data = self.rest + data
        at, end = 16, len(data)
        while end - at >= 8 and end - at >= (size := int.from_bytes(data[at : at + 4])):
            if data[at + 7] == 3:
                for first, last, sends in self.cuts:
                    message = data[at + first : at + last]
                    for send in sends:
                        send(message)
            at += size
        self.rest = data[at - 16 :]

    def connection_lost(self, exc):
        self.ended.set()


async def main(port, cuts):
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    while not stop.is_set():
        ended = asyncio.Event()
        await asyncio.get_running_loop().create_connection(lambda: Relay(cuts, ended), "127.0.0.1", port)
        await asyncio.wait([asyncio.create_task(e.wait()) for e in (ended, stop)], return_when="FIRST_COMPLETED")


def sends(plan, session, channels, component, schema):
    if session:
        encoding = zenoh.Encoding(LCM_ENCODING).with_schema(schema)
        drop = zenoh.CongestionControl.DROP
        yield session.declare_publisher(f"mocap/{plan['name']}/{component}", encoding=encoding, congestion_control=drop).put
    if channels:
        yield partial(channels.publish, f"MOCAP_{plan['name'].upper()}_{component.upper()}")


if __name__ == "__main__":
    plan = json.loads(sys.argv[1])
    session = zenoh.open(zenoh_config(plan["zenoh"])) if plan["zenoh"] else None
    channels = lcm.LCM(plan["lcm"]) if plan["lcm"] else None
    cuts = [(first, last, tuple(sends(plan, session, channels, *names))) for first, last, *names in plan["cuts"]]
    asyncio.run(main(plan["port"], cuts))
    if session:
        session.close()
