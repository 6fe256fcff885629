"""Zenoh routers that describe themselves, as zenohd does, and sessions that are connected to them."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import zenoh

from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys


class Routers:
    """Routers that are called by their names, and sessions that are connected to them."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.endpoints: dict[str, str] = {}

    def start(self, name: str, *, linked_with: str | None = None, **keys: Any) -> zenoh.Session:
        """Run a router that describes itself, as zenohd does."""
        listen = self.endpoints[name] = free_endpoint()
        connect = self.endpoints[linked_with] if linked_with else None
        config = zenoh_keys("router", connect=connect, listen=listen)
        config |= {"metadata": {"name": name}, "adminspace": {"enabled": True}} | keys
        return self._opened(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))

    def client(self, router: str) -> zenoh.Session:
        """Return a session that is a client of a router."""
        return self._opened(open_zenoh("client", connect=self.endpoints[router]))

    def peer(self, *routers: str) -> zenoh.Session:
        """Return a session that is a peer with links to routers."""
        config = zenoh_keys("peer")
        config["connect"]["endpoints"] = [self.endpoints[name] for name in routers]
        return self._opened(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))

    def _opened(self, session: zenoh.Session) -> zenoh.Session:
        self._stack.callback(session.close)
        return session


@contextmanager
def run_routers() -> Iterator[Routers]:
    """Close all routers and sessions at the end."""
    with ExitStack() as stack:
        yield Routers(stack)
