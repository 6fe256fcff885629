"""The tests of this folder run in virtual time; those of names control how host names are resolved."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from gateway.session import tcp
from tests.support.clocks import VirtualTimeLoop


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"virtual": VirtualTimeLoop}


class Resolver:
    """Like socket.getaddrinfo: waits for ``answers``, raises ``error`` or returns ``addresses``.

    ``names`` are those that were looked up.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.addresses = ["127.0.0.1"]
        self.error: BaseException | None = None
        self.answers = threading.Event()
        self.answers.set()

    def __call__(self, host: str, _port: object, **_options: object) -> list[tuple[Any, ...]]:
        self.names.append(host)
        self.answers.wait(60)
        if self.error is not None:
            raise self.error
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in self.addresses]


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Resolver]:
    resolver = Resolver()
    tcp._look_ups.clear()  # one of a former test that has ended late would answer this one
    monkeypatch.setattr(socket, "getaddrinfo", resolver)
    yield resolver
    resolver.answers.set()
