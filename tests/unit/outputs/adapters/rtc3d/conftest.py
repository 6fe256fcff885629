"""Tests of the output for RTC3D clients run in virtual time, with a scripted server and a client of it."""

import asyncio
from collections.abc import Callable, Mapping

import pytest

from tests.support.clocks import VirtualTimeLoop
from tests.unit.outputs.adapters.rtc3d.scripted_server import Client, ScriptedServer


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]] | None:
    if item.path.name == "test_settings.py":
        return None  # it has real sockets
    return {"virtual": VirtualTimeLoop}


@pytest.fixture
async def server() -> ScriptedServer:
    return ScriptedServer()


@pytest.fixture
async def client(server: ScriptedServer) -> Client:
    return server.client()
