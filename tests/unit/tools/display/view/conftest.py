"""A server of the view, and a source with live data."""

from collections.abc import Iterator

import pytest

from gateway.tools.display.view.viewer import ViewServer, open_server
from tests.unit.tools.display.live_lab import Lab


@pytest.fixture
def server() -> Iterator[ViewServer]:
    server = open_server("127.0.0.1", 0)
    yield server
    server.stop()


@pytest.fixture
def lab() -> Lab:
    return Lab()
