"""The doctor's checks of the output for RTC3D clients."""

import asyncio
import logging
import socket
from contextlib import closing

import pytest

from gateway.findings import Finding, Result
from gateway.outputs.rtc3d.checks import CHECKS, check_rtc3d
from gateway.outputs.rtc3d.settings import Rtc3dSettings
from gateway.simulator.simulator import Simulator
from tests.networks import free_port
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.waiting import wait_until_async


def findings(sources: list[str], ports: dict[str, int], host: str = "127.0.0.1") -> list[Finding]:
    found = check_rtc3d(Rtc3dSettings(enabled=True, host=host, ports=ports), sources, [], 0.3)
    assert [each.check for each in found][:2] == list(CHECKS)
    return found


def test_free_ports_for_all_sources_are_as_they_should_be() -> None:
    found = findings(["lab"], {"lab": free_port()})
    assert {each.result for each in found} == {Result.PASSING}


def test_a_port_for_an_unknown_source_is_a_warning() -> None:
    names, _ = findings(["lab", "hall"], {"lap": free_port()})
    assert names.result is Result.WARNING
    assert names.found == "rtc3d.ports has a port for lap, which is no source"
    assert names.remedy == "Correct the name; the sources are lab, hall."


def test_a_source_without_a_port_is_a_note() -> None:
    names, _ = findings(["lab", "hall"], {"lab": free_port()})
    assert (names.result, names.found) == (Result.NOTE, "RTC3D clients cannot connect to hall")


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_a_port_of_another_program_fails(answer: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with closing(socket.create_connection(("127.0.0.1", port))), other.accept()[0] as accepted:
            accepted.sendall(answer)
            *_, finding = findings(["lab"], {"lab": port})
    assert finding.result is Result.FAILING
    assert finding.found.startswith(f"cannot listen on 127.0.0.1, port {port} (for lab): ")
    assert "rtc3d.ports.lab" in finding.remedy


def test_an_address_of_another_computer_fails() -> None:
    *_, finding = findings(["lab"], {"lab": free_port()}, host="192.0.2.1")
    assert finding.result is Result.FAILING


async def test_the_port_of_a_running_gateway_passes(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with Simulator(CountingScene()) as server:
        *_, finding = await asyncio.to_thread(findings, ["lab"], {"lab": server.port})
        await wait_until_async(lambda: "disconnected" in caplog.text)
    assert "reset" not in caplog.text
    assert finding.result is Result.PASSING
    assert "the gateway, if it runs" in finding.found
