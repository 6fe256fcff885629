"""Fixtures of several integration tests."""

from collections.abc import Iterator

import pytest

from tests.networks import free_endpoint, open_zenoh


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a Zenoh router."""
    endpoint = free_endpoint()
    session = open_zenoh("router", listen=endpoint)
    yield endpoint
    session.close()
