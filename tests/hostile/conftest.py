"""The healthy source of all tests in this folder, and a table of their figures at the end of the run."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest

from tests.hostile.gateway_under_attack import HEALTHY_SCENE, GatewayUnderAttack, RunningGateway, run_gateway
from tests.support.gateway_process import simulator

_PROPERTY: Final = "the healthy source"


@pytest.fixture(scope="session")
def healthy_server() -> Iterator[int]:
    """The port of the healthy server, a process of its own."""
    with simulator(*HEALTHY_SCENE) as (port, _):
        yield port


@pytest.fixture(scope="module")
def dense_server() -> Iterator[int]:
    """The port of a server that fills the buffers of a peer that does not read within a second."""
    scene = ("--markers", "1000", "--tools", "100", "--rate", "200", "--analog-rate", "200")
    with simulator(*scene) as (port, _):
        yield port


@pytest.fixture
def gateway_under_attack(
    tmp_path: Path, healthy_server: int, request: pytest.FixtureRequest
) -> GatewayUnderAttack:
    """Run a gateway with the healthy source and attackers; see gateway_under_attack.py."""

    @asynccontextmanager
    async def run(*arguments: Any, **options: Any) -> AsyncIterator[RunningGateway]:
        async with partial(run_gateway, tmp_path, healthy_server)(*arguments, **options) as gateway:
            yield gateway
        request.node.user_properties.append((_PROPERTY, str(gateway.report)))

    return run


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the figures, which the reports of the tests bring along from the workers of xdist, too."""
    figures = [
        f"{report.nodeid.rpartition('/')[2]}: {text}"
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", "") == "call"
        for key, text in report.user_properties
        if key == _PROPERTY
    ]
    if figures:
        terminalreporter.section("the healthy source during attacks")
        for line in figures:
            terminalreporter.write_line(line)
