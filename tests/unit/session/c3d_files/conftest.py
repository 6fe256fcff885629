"""The tests of this folder run in real time, as most tests do: they wait for threads."""

from tests.conftest import pytest_asyncio_loop_factories

__all__ = ["pytest_asyncio_loop_factories"]
