"""One machine for all tests here, with the gateway installed; and its service, anew for each."""

import shutil
import subprocess
from collections.abc import AsyncIterator, Iterator

import pytest
import uvloop

from tests.clones import ROOT, clone_into, files_in
from tests.networks import free_endpoint
from tests.systemd.machine import CLONE, DROP_INS, Machine, Service
from tests.systemd.page import typed


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """A machine on which ``make install`` has been run from a clean copy of this repository."""
    # It lives as long as cat does, which ends with this process's end of the pipe, however that ends.
    command = ["tests/systemd/with-systemd", "sh", "-c", "echo $MACHINE; exec cat"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        booted = Machine(int(process.stdout.readline()))
        clone_into(booted.path(CLONE))
        before = files_in(booted.path(CLONE))
        booted.said_installing = uvloop.run(booted.type(typed("Install", 1))).text
        booted.left_in_clone = files_in(booted.path(CLONE)) - before
        yield booted


@pytest.fixture
async def service(machine: Machine) -> AsyncIterator[Service]:
    """The service, not configured and not started; it is stopped afterwards, and changed back."""
    yield Service(machine, free_endpoint())
    await machine.run("systemctl", "stop", "rtc3d-gateway*.service")
    await machine.run("systemctl", "reset-failed")
    shutil.rmtree(machine.path(DROP_INS), ignore_errors=True)
    await machine.run("systemctl", "daemon-reload")
