"""The event loop of tests that need neither sockets nor threads: its time is virtual."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Final

import pytest

from tests.unit.stream.virtual_time import VirtualTimeLoop

_IN_VIRTUAL_TIME: Final = {"test_daemon.py", "test_gateway.py", "test_source.py"}


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]] | None:
    if item.path.name in _IN_VIRTUAL_TIME:
        return {"virtual": VirtualTimeLoop}
    return None  # as tests/conftest.py says
