"""Tests of faults run in virtual time, which the faults read, too."""

import asyncio
import types
from collections.abc import AsyncIterator, Callable, Mapping

import pytest

from tests.support.clocks import VirtualTimeLoop
from tests.unit.simulator.faults.faulty_client import FaultyClient


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"virtual": VirtualTimeLoop}


@pytest.fixture
async def client(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[FaultyClient]:
    """A client for which nothing waits any more once the faults have ended."""
    clock = types.SimpleNamespace(monotonic=lambda: asyncio.get_running_loop().time())
    monkeypatch.setattr("gateway.simulator.fault_pipeline.time", clock)
    client = FaultyClient()
    yield client
    await client.faults.clear()
    assert client.filter.waiting_bytes == 0
