"""An output on Zenoh for each test; ``with_settings`` replaces its settings."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

from tests.unit.outputs.zenoh.lab import Lab, QueriedLab


@pytest.fixture
def settings() -> dict[str, Any]:
    return {}


@pytest.fixture
def lab(settings: dict[str, Any]) -> Iterator[Lab]:
    """An output that is not open."""
    lab = Lab(**settings)
    yield lab
    lab.close()


@pytest.fixture
async def queried(settings: dict[str, Any]) -> AsyncIterator[QueriedLab]:
    """An open output with queries."""
    lab = QueriedLab(**settings)
    await asyncio.to_thread(lab.open)
    yield lab
    await lab.stop()
