"""Fixtures: one machine with the gateway installed, and for each test its service."""

import shutil
from collections.abc import AsyncIterator, Iterator

import pytest
import uvloop

from tests.support.fresh_clones import clone_into, files_in
from tests.support.networks import free_endpoint
from tests.systemd.machine import CLONE, DROP_INS, Machine, Service, booted, commands

QUICKLY = "export CC=/run/repository/tests/quick-cc\n" if shutil.which("cc") else ""


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """Return a machine on which ``make install`` has run from a clean copy of this repository."""
    with booted() as machine:
        clone_into(machine.path(CLONE))
        before = files_in(machine.path(CLONE))
        machine.install_output = uvloop.run(
            machine.run_shell(QUICKLY + commands("Install from source", 2))
        ).text
        machine.left_in_clone = files_in(machine.path(CLONE)) - before
        yield machine


@pytest.fixture
async def service(machine: Machine) -> AsyncIterator[Service]:
    """Return the service, not configured and not started; it is stopped and restored afterwards."""
    yield Service(machine, free_endpoint())
    await machine.run("systemctl", "stop", "rtc3d-gateway*.service")
    await machine.run("systemctl", "reset-failed")
    shutil.rmtree(machine.path(DROP_INS), ignore_errors=True)
    await machine.run("systemctl", "daemon-reload")
