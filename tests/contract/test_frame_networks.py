"""Networks that fail and peers that misbehave, for every output that takes whole frames."""

import asyncio
import os
import socket
import time
from contextlib import suppress
from typing import Final

import numpy as np

from gateway.errors import OutputError
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ComponentType
from tests.contract.frame_lab import (
    Lab,
    can_be_cut,
    every_real_rig,
    has_router,
    lab,
    listens,
    names_remedy,
    returns,
)
from tests.contract.frame_rigs import LAB, SOURCES, FrameRig, component, frame_of
from tests.support.waiting import wait_until_async

__all__ = ["lab"]

NUM_STALLED: Final = 3000

GARBAGE: Final = {
    "nothing": b"",
    "one byte": b"\x00",
    "zeros": bytes(100_000),
    "ones": b"\xff" * 100_000,
    "HTTP": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "an endless header": b"GET / HTTP/1.1\r\n" + b"X: " + b"x" * 1_000_000,
    "TLS": bytes.fromhex("16030100f5010000f10303") + bytes(234),
    "SSH": b"SSH-2.0-OpenSSH_9.7\r\n",
    "VRPN of another version": b"vrpn: ver. 99.99  9".ljust(24, b"\x00"),
    "a cookie, then a body of 2 GB": b"vrpn: ver. 07.35  0".ljust(24, b"\x00") + b"\x7f\xff\xff\xff" * 6,
    "an RTC3D packet of 4 GB": b"\xff\xff\xff\xff\x00\x00\x00\x01Version 1.0",
    "an RTC3D command without end": b"\x00\x10\x00\x00\x00\x00\x00\x01" + b"StreamFrames " * 1000,
    "an RTC3D command of zeros": b"\x00\x00\x00\x10\x00\x00\x00\x01" + bytes(8),
    "half a WebSocket handshake": b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nSec-WebSocket-Key: x\r\n\r\n",
    "text": "à la carte\r\n".encode() * 10_000,
}
"""What programs send that speak another protocol, or none."""


# Without a network -----------------------------------------------------------------------------------


async def start_without_a_network(lab: Lab) -> None:
    await asyncio.to_thread(lab.rig.cut)
    lab.serve()
    lab.output.start()


@can_be_cut
async def test_an_output_started_without_a_network_recovers_by_itself(lab: Lab) -> None:
    """Until then, ``health`` names the remedy and what is lost is counted."""
    await start_without_a_network(lab)
    await wait_until_async(lambda: names_remedy(lab))
    lab.publish_next()
    assert set(lab.lost()) <= {"not open", "no router"}
    await asyncio.to_thread(lab.rig.restore)
    await wait_until_async(lambda: lab.output.health().connected)
    await lab.subscribe()


@can_be_cut
async def test_closing_is_safe_without_a_network(lab: Lab) -> None:
    await start_without_a_network(lab)
    await returns(lab.output.close)
    assert not lab.output.health().connected


@has_router
async def test_a_lost_router_is_reported_and_frames_leave_again_once_it_is_back(lab: Lab) -> None:
    await lab.start()
    await asyncio.to_thread(lab.rig.cut)
    await wait_until_async(lambda: names_remedy(lab))
    lab.publish_next()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await asyncio.to_thread(lab.rig.restore)
    await wait_until_async(lambda: lab.output.health().connected)
    await lab.subscribe()


# Peers ------------------------------------------------------------------------------------------------


@every_real_rig
async def test_a_peer_that_never_reads_holds_up_nobody(lab: Lab) -> None:
    await lab.start()
    await asyncio.to_thread(lab.rig.stall)
    large = frame_of(
        component(1, ComponentType.MARKERS, np.zeros(1000, ITEM_DTYPES[ComponentType.MARKERS])),
        *(component(1, kind) for kind in WIRE_ORDER[1:]),
    )

    def publish_much() -> None:
        for number in range(NUM_STALLED):
            with suppress(OutputError):
                lab.publish(LAB, large)
            if number % 100 == 0:
                time.sleep(0)  # on a busy computer, this takes some ms

    await returns(publish_much)
    for source in SOURCES:
        await lab.arrives(source)
    await returns(lab.output.maintain)
    await returns(lab.output.close)


@listens
async def test_other_protocols_and_garbage_do_not_disturb_the_next_peer(lab: Lab) -> None:
    await lab.start()
    for data in (*GARBAGE.values(), os.urandom(10_000)):
        await returns(lambda data=data: attack(lab.rig, data))  # type: ignore[misc]
    await lab.arrives_next()
    await lab.subscribe()
    assert lab.output.health().connected


@listens
async def test_connections_that_say_nothing_do_not_keep_others_out(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    assert lab.rig.tcp_port is not None
    silent = [
        await asyncio.to_thread(socket.create_connection, ("127.0.0.1", lab.rig.tcp_port)) for _ in range(20)
    ]
    try:
        await lab.subscribe()
    finally:
        for connection in silent:
            connection.close()


def attack(rig: FrameRig, data: bytes) -> None:
    """Send data to the ports of an output, close one connection at once and half-close another."""
    if rig.tcp_port is not None:
        for is_half_open in (False, True):
            with suppress(OSError), socket.create_connection(("127.0.0.1", rig.tcp_port), 1) as connection:
                connection.settimeout(0.2)
                connection.sendall(data)
                if is_half_open:
                    connection.shutdown(socket.SHUT_WR)
                connection.recv(65536)
    if rig.udp_port is not None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, suppress(OSError):
            sender.sendto(data[:60_000], ("127.0.0.1", rig.udp_port))
