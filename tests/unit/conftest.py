"""Fixtures of tests that need neither sockets nor threads, and their event loop, whose time is virtual."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Final

import pytest

from tests.support.clocks import Clock, VirtualTimeLoop
from tests.unit.daemon.scripted_sources import Servers, SlowThreads, use_scripted_servers

_IN_VIRTUAL_TIME: Final = {
    "test_daemon.py",
    "test_gateway.py",
    "test_gateway_defects.py",
    "test_source.py",
    "test_source_parameters.py",
}


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]] | None:
    if item.path.name in _IN_VIRTUAL_TIME:
        return {"virtual": VirtualTimeLoop}
    return None  # as tests/conftest.py says


@pytest.fixture
async def servers(monkeypatch: pytest.MonkeyPatch) -> Servers:
    """Connect all sources to scripted servers, by the name of their host."""
    return use_scripted_servers(monkeypatch)


@pytest.fixture
async def threads(servers: Servers) -> SlowThreads:
    """The threads that stand for those of ``call_in_thread``."""
    return servers.threads


@pytest.fixture
def clock() -> Clock:
    return Clock()
