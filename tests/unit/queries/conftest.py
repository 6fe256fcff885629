"""A source whose server the test controls."""

import pytest

from tests.unit.queries.fake_source import MM, FakeSource


@pytest.fixture
async def source() -> FakeSource:
    """A source that has read the parameters MM."""
    source = FakeSource()
    await source.store_parameters(MM)
    return source
