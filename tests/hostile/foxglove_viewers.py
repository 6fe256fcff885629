"""Hostile viewers on the port of the output ``foxglove``, in a process of their own.

python -m tests.hostile.foxglove_viewers NAME PORT
"""

import asyncio
import json
import os
import sys
from typing import Final

from tests.foxglove_viewer import PING, client_frame, upgrade_request
from tests.hostile.port_attacks import Attack, endless, repeating, short, silent, stalled, together

KEY: Final = b"AAAAAAAAAAAAAAAAAAAAAA=="
HANDSHAKE: Final = upgrade_request(KEY, "foxglove.sdk.v1")
_CHANNELS: Final = [{"id": number, "channelId": number} for number in range(100)]
SUBSCRIBE: Final = client_frame(json.dumps({"op": "subscribe", "subscriptions": _CHANNELS}).encode())
_UNSUBSCRIBE: Final = client_frame(
    json.dumps({"op": "unsubscribe", "subscriptionIds": list(range(100))}).encode()
)
_NO_REQUESTS: Final = (
    *(b"[" * 10_000, b"{}", b"1" * 5000),
    b'{"op":"subscribe","subscriptions":[{"id":-1}]}',
)
_16_EB: Final = bytes((0x81, 0xFF)) + b"\x7f" + b"\xff" * 7 + bytes(4)
_EMPTY_PIECES: Final = (b"\x00\x80" + bytes(4)) * 100

ATTACKS: Final[dict[str, Attack]] = {
    "garbage": together(
        endless(b"", os.urandom(5000)),
        endless(b"GET / HTTP/1.1\r\n", b"X: " + b"x" * 4000 + b"\r\n"),
        endless(HANDSHAKE, os.urandom(5000)),
        short(lambda: upgrade_request(KEY, "chat")),
    ),
    "half_open": together(silent(100), stalled(100, HANDSHAKE[:60])),
    "huge": together(
        endless(HANDSHAKE + _16_EB, bytes(100_000)),
        endless(HANDSHAKE, client_frame(b'"' + b"x" * 1_000_000 + b'"')),
        endless(HANDSHAKE + b"\x01\x80" + bytes(4), _EMPTY_PIECES),
    ),
    "requests": together(
        endless(HANDSHAKE, b"".join(map(client_frame, _NO_REQUESTS))),
        endless(HANDSHAKE, SUBSCRIBE + _UNSUBSCRIBE),
        endless(HANDSHAKE, client_frame(b"ping", PING) * 100),
    ),
    "stalled": stalled(200, HANDSHAKE + SUBSCRIBE),  # more than are accepted
    "connecting": together(*[short(lambda: HANDSHAKE + SUBSCRIBE)] * 4),
}


if __name__ == "__main__":
    asyncio.run(repeating(ATTACKS[sys.argv[1]], int(sys.argv[2])))
