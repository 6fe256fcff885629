"""Fixtures: one machine with the gateway installed, and for each test its service."""

import shutil
import subprocess
from collections.abc import AsyncIterator, Iterator

import pytest
import uvloop

from tests.support.fresh_clones import ROOT, clone_into, files_in
from tests.support.networks import free_endpoint
from tests.systemd.machine import CLONE, DROP_INS, Machine, Service, commands

QUICKLY = "export CC=/run/repository/tests/quick-cc\n" if shutil.which("cc") else ""


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """Return a machine on which ``make install`` has run from a clean copy of this repository."""
    # The machine runs until cat ends, which happens when this process closes the pipe or dies.
    command = ["tests/systemd/with-systemd", "sh", "-c", "echo $MACHINE; exec cat"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        booted = Machine(int(process.stdout.readline()))
        clone_into(booted.path(CLONE))
        before = files_in(booted.path(CLONE))
        booted.install_output = uvloop.run(booted.run_shell(QUICKLY + commands("Install", 2))).text
        booted.left_in_clone = files_in(booted.path(CLONE)) - before
        yield booted


@pytest.fixture
async def service(machine: Machine) -> AsyncIterator[Service]:
    """Return the service, not configured and not started; it is stopped and restored afterwards."""
    yield Service(machine, free_endpoint())
    await machine.run("systemctl", "stop", "rtc3d-gateway*.service")
    await machine.run("systemctl", "reset-failed")
    shutil.rmtree(machine.path(DROP_INS), ignore_errors=True)
    await machine.run("systemctl", "daemon-reload")
