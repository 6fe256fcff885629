"""Delay IP packets: read them from a TUN interface, and write each one back after a fixed time.

python -m benchmarks.sites.delay DEVICE MILLISECONDS

It stands in for netem, which not every kernel has. Packets stay in order.
"""

import fcntl
import os
import select
import struct
import sys
import time
from collections import deque
from typing import Final

_TUNSETIFF: Final = 0x400454CA
_IFF_TUN: Final = 0x0001
_IFF_NO_PI: Final = 0x1000
_PACKET_BYTES: Final = 65_536
_PACKETS: Final = 10_000
"""How many packets wait at most, 15 MB; further ones are dropped."""


def delay(device: str, delay_s: float) -> None:
    """Delay packets until the process is ended."""
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH14x", device.encode(), _IFF_TUN | _IFF_NO_PI))
    waiting: deque[tuple[float, bytes]] = deque()
    while True:
        timeout_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        if select.select([tun], [], [], timeout_s)[0]:
            packet = os.read(tun, _PACKET_BYTES)
            if len(waiting) < _PACKETS:
                waiting.append((time.monotonic() + delay_s, packet))
        while waiting and waiting[0][0] <= time.monotonic():
            os.write(tun, waiting.popleft()[1])


if __name__ == "__main__":
    delay(sys.argv[1], float(sys.argv[2]) / 1000)
