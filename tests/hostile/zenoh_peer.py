"""A hostile peer on Zenoh, in a process of its own: many sessions, declarations without end.

    python -m tests.hostile.zenoh_peer KIND ENDPOINT COUNT

It prints "done" after it has done this COUNT times, keeps everything open, and ends with stdin.

    python -m tests.hostile.zenoh_peer ask ENDPOINT COUNT PAYLOAD_BYTES SELECTOR...

See ``ask``.
"""

import json
import os
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import zenoh

from tests.support.networks import open_zenoh, zenoh_keys

_BUFFER_BYTES: Final = 4096
"""The receive buffer: small, so that a peer that does not read is noticed soon."""

_ANSWER_TIMEOUT_S: Final = 20.0

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


def ask(endpoint: str, count: int, payload: bytes, selectors: list[str]) -> None:
    """Send ``count`` queries at once, with the selectors in turn, and print a line when they are sent.

    "{}" in a selector stands for the number of the query. When every query has ended, print a JSON object:
    the number of replies by code ("ok", or the code of the error), and of queries without any.
    """
    counts: Counter[str] = Counter()
    unanswered = set(range(count))
    ended = threading.Semaphore(0)

    def receive(number: int, reply: zenoh.Reply) -> None:
        unanswered.discard(number)
        counts["ok" if reply.err is None else str(reply.err.encoding).rpartition(";")[2]] += 1

    with open_zenoh("client", connect=endpoint) as session:
        for number in range(count):
            session.get(
                selectors[number % len(selectors)].replace("{}", str(number)),
                zenoh.handlers.Callback(partial(receive, number), drop=ended.release),
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_ANSWER_TIMEOUT_S,
                payload=payload or None,
            )
        print("sent", flush=True)
        for _ in range(count):
            ended.acquire(timeout=_ANSWER_TIMEOUT_S)
        print(json.dumps(counts | {"unanswered": len(unanswered)}), flush=True)


def main() -> None:
    kind, endpoint, count, *others = sys.argv[1], sys.argv[2], int(sys.argv[3]), *sys.argv[4:]
    if kind == "ask":
        ask(endpoint, count, bytes(int(others[0])), others[1:])
        return
    kept: list[Any] = []

    def attack() -> None:
        kept.extend(KINDS[kind](endpoint, count))
        print("done", flush=True)

    threading.Thread(target=attack, daemon=True).start()
    sys.stdin.read()
    os._exit(0)  # a session that is not closed would keep the process alive


if __name__ == "__main__":
    main()
