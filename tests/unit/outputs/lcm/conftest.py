"""An output on LCM in memory with its query service."""

from collections.abc import AsyncIterator

import pytest

from tests.unit.outputs.lcm.peer import Lab


@pytest.fixture
async def lab(request: pytest.FixtureRequest) -> AsyncIterator[Lab]:
    """An open output; ``with_settings`` replaces its settings."""
    lab = Lab(**getattr(request, "param", {}))
    lab.open()
    yield lab
    lab.service.may_answer.set()
    await lab.output.stop_queries()
    lab.output.close()
