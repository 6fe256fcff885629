"""Fixtures of several integration tests."""

from collections.abc import Iterator

import pytest

from tests.integration.served import Served, directly, through_a_gateway
from tests.networks import free_endpoint, open_zenoh


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a Zenoh router."""
    endpoint = free_endpoint()
    session = open_zenoh("router", listen=endpoint)
    yield endpoint
    session.close()


@pytest.fixture(params=[directly, through_a_gateway])
def served(request: pytest.FixtureRequest) -> Served:
    """How clients reach a simulator."""
    serve: Served = request.param
    return serve
