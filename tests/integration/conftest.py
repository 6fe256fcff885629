"""Fixtures of several integration tests."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.networks import free_endpoint, open_zenoh
from tests.support.secure_zenoh import SecureRouter, make_certificates, run_secure_router


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a Zenoh router."""
    endpoint = free_endpoint()
    session = open_zenoh("router", listen=endpoint)
    yield endpoint
    session.close()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("ours") / "tls")


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory, certificates: Path) -> Iterator[SecureRouter]:
    """A router with access control, and a gateway that streams through it."""
    with run_secure_router(tmp_path_factory.mktemp("lab"), certificates) as running:
        yield running
