"""A hostile peer on Zenoh, in a process of its own: many sessions, declarations without end.

    python -m tests.hostile.zenoh_peer KIND ENDPOINT COUNT

It prints "done" after it has done this COUNT times, keeps everything open, and ends with stdin.
"""

import json
import os
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final

import zenoh

from tests.networks import zenoh_keys

_BUFFER_BYTES: Final = 4096
"""The receive buffer: small, so that a peer that does not read is noticed soon."""

_LEASE_MS: Final = 60_000
"""Zenoh closes the link of a silent peer after the lease that this peer has announced."""


def _open(endpoint: str) -> zenoh.Session:
    keys = zenoh_keys("client", connect=endpoint)
    keys["transport"]["link"] = {"tcp": {"so_rcvbuf": _BUFFER_BYTES}, "tx": {"lease": _LEASE_MS}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))


def _routers(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` routers, for each of which the gateway is a peer, with a subscriber."""
    for _ in range(count):
        keys = zenoh_keys("router", connect=endpoint, listen="tcp/127.0.0.1:0")
        keys["transport"]["link"] = {"tcp": {"so_rcvbuf": _BUFFER_BYTES}, "tx": {"lease": _LEASE_MS}}
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))
        yield session, session.declare_subscriber("mocap/**", _ignore)


def _ignore(_: Any) -> None:
    pass


def _subscribers(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` subscribers with a session each."""
    for _ in range(count):
        session = _open(endpoint)
        yield session, session.declare_subscriber("mocap/**", _ignore)


def _connections(endpoint: str, count: int) -> Iterator[Any]:
    """Subscribers that connect and disconnect, one after the other."""
    for _ in range(count):
        with _open(endpoint) as session:
            session.declare_subscriber("mocap/**", _ignore)
        yield None


def _keys(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` subscribers of one session, on keys of their own."""
    session = _open(endpoint)
    for number in range(count):
        yield session, session.declare_subscriber(f"mocap/healthy/{number}", _ignore)


def _patterns(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` subscribers of one session, on key expressions that match every source."""
    session = _open(endpoint)
    for number in range(count):
        yield session, session.declare_subscriber(f"mocap/*/{number}/**", _ignore)


def _tokens(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` liveliness tokens."""
    session = _open(endpoint)
    for number in range(count):
        yield session, session.liveliness().declare_token(f"mocap/healthy/{number}")


def _puts(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` messages that nobody has asked for."""
    session = _open(endpoint)
    for _ in range(count):
        session.put("mocap/healthy/parameters/nonsense", bytes(1000))
        yield session


def _json(endpoint: str, count: int) -> Iterator[Any]:
    """``count`` subscribers to everything as JSON, with a session each."""
    for _ in range(count):
        session = _open(endpoint)
        yield session, session.declare_subscriber("mocap/**/json", _ignore)


KINDS: Final[dict[str, Callable[[str, int], Iterator[Any]]]] = {
    "routers": _routers,
    "subscribers": _subscribers,
    "connections": _connections,
    "keys": _keys,
    "patterns": _patterns,
    "tokens": _tokens,
    "puts": _puts,
    "json": _json,
}


def main() -> None:
    kind, endpoint, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    kept: list[Any] = []

    def attack() -> None:
        kept.extend(KINDS[kind](endpoint, count))
        print("done", flush=True)

    threading.Thread(target=attack, daemon=True).start()
    sys.stdin.read()
    os._exit(0)  # a session that is not closed would keep the process alive


if __name__ == "__main__":
    main()
