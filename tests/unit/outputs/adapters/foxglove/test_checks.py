"""The doctor's checks: the packages, and the port, which a running gateway may use already."""

import asyncio
import importlib.metadata
import socket
import sys

import pytest

from gateway.errors import ConfigError
from gateway.outputs.adapters.foxglove import checks
from gateway.outputs.adapters.foxglove.checks import check_foxglove
from gateway.outputs.adapters.foxglove.settings import FOXGLOVE, FoxgloveSettings
from gateway.outputs.findings import Finding, Result
from tests.support.errors import names, raises
from tests.support.networks import free_port
from tests.unit.outputs.adapters.foxglove.live import serving


def check(port: int, *sources: str, host: str = "127.0.0.1") -> tuple[Finding, Finding]:
    package, port_finding = check_foxglove(FoxgloveSettings(host=host, port=port), sources, (), 1.0)
    return package, port_finding


@pytest.mark.parametrize("host", ["127.0.0.1", "::", "0.0.0.0", "localhost"])  # noqa: S104 - free at once
def test_a_free_port_passes(host: str) -> None:
    package, port = check(free_port(), host=host)
    assert (package.result, port.result) == (Result.PASSING, Result.PASSING)
    assert "foxglove-sdk" in package.found
    assert "ws://" in port.found


async def test_a_gateway_that_is_running_passes_if_it_serves_all_sources() -> None:
    async with serving("lab", "hall") as (port, _):
        _, found = await asyncio.to_thread(check, port, "lab", "hall")
        text = f"a gateway serves viewers at ws://127.0.0.1:{port}, with 12 topics"
        assert (found.result, found.found) == (Result.PASSING, text)
        _, found = await asyncio.to_thread(check, port, "lab", "stage")
        assert found.result is Result.WARNING
        assert found.found.endswith("but not stage")


def test_ports_of_other_programs_and_addresses_of_other_computers_fail(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(checks, "_TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for host, text in (("127.0.0.1", "Address already in use"), ("192.0.2.1", "Cannot assign requested")):
            _, found = check(port, host=host)
            assert found.result is Result.FAILING
            assert text in found.found
            assert f"uses port {port}" in found.remedy


def test_a_package_that_is_missing_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "websockets":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(checks, "version", version)
    package, port = check(free_port())
    assert (package.result, port.result) == (Result.FAILING, Result.NOT_TESTED)
    assert names(package.found, "websockets")
    assert names(package.remedy, "'rtc3d-gateway[foxglove]'")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    for name in list(sys.modules):
        if name.startswith(("gateway.messages.foxglove", "gateway.outputs.adapters.foxglove.")):
            monkeypatch.delitem(sys.modules, name)
    with raises(ConfigError, "'rtc3d-gateway[foxglove]'"):
        FOXGLOVE.create(FoxgloveSettings(enabled=True))


def test_data_leaves_the_computer_unless_the_address_is_loopback() -> None:
    hosts = ("127.0.0.1", "::1", "::", "lab.example.org")
    assert [FOXGLOVE.leaves_host(FoxgloveSettings(host=host)) for host in hosts] == [False, False, True, True]
