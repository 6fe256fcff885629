"""The section ``rtc3d`` of the configuration, and the doctor's checks of it."""

import asyncio
import logging
import socket
from contextlib import closing
from typing import Any

import pytest

from gateway.outputs.adapters.rtc3d.output import check_rtc3d
from gateway.outputs.adapters.rtc3d.settings import RTC3D, Rtc3dSettings
from gateway.outputs.findings import Finding, Result
from gateway.simulator.simulator import Simulator
from tests.support.configurations import mistakes
from tests.support.errors import names
from tests.support.networks import free_port
from tests.support.waiting import wait_until_async
from tests.unit.session.server.counting_scene import CountingScene


def test_by_default_it_is_off_and_listens_on_this_computer_only() -> None:
    assert (Rtc3dSettings().enabled, RTC3D.leaves_host(Rtc3dSettings())) == (False, False)
    assert Rtc3dSettings(enabled=True, ports={"lab": 3120, "hall-2": 3121}).ports["hall-2"] == 3121
    for host, leaves in (("::1", False), ("localhost", False), ("::", True), ("lab-pc", True)):
        assert RTC3D.leaves_host(Rtc3dSettings(host=host)) is leaves


@pytest.mark.parametrize(
    ("values", "place", "text"),
    [
        ({"enabled": True}, "ports", "found nothing; expected "),
        (
            {"ports": {"lab": 3120, "hall": 3120}},
            "ports.hall",
            "found 3120, which lab",
        ),
        ({"ports": {"lab": 0}}, "ports.lab", ""),
        ({"ports": {"a lab": 3120}}, "ports.a lab", ""),
        ({"ports": 3120}, "ports", ""),
        ({"max_clients": 0}, "max_clients", ""),
    ],
)
def test_mistakes_have_their_place(values: dict[str, Any], place: str, text: str) -> None:
    [(found_place, found)] = mistakes(Rtc3dSettings, values)
    assert found_place.startswith(place)
    assert found.startswith(text)


# Checks -------------------------------------------------------------------------------------


def findings(sources: list[str], ports: dict[str, int], host: str = "127.0.0.1") -> list[Finding]:
    found = check_rtc3d(Rtc3dSettings(enabled=True, host=host, ports=ports), sources, [], 0.3)
    assert [each.check for each in found][:2] == list(RTC3D.checks)
    return found


@pytest.mark.parametrize(
    ("sources", "port_of", "result", "text"),
    [
        (["lab"], "lab", Result.PASSING, ""),
        (["lab", "hall"], "lap", Result.WARNING, "lap"),
        (["lab", "hall"], "lab", Result.NOTE, "hall"),
    ],
)
def test_ports_are_those_of_the_sources(sources: list[str], port_of: str, result: Result, text: str) -> None:
    named, ports = findings(sources, {port_of: free_port()})
    assert (named.result, text in named.found, ports.result) == (result, True, Result.PASSING)
    assert result is not Result.WARNING or names(named.remedy, "lab, hall")


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_a_port_of_another_program_fails(answer: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with closing(socket.create_connection(("127.0.0.1", port))), other.accept()[0] as accepted:
            accepted.sendall(answer)
            *_, finding = findings(["lab"], {"lab": port})
    assert finding.result is Result.FAILING
    assert names(finding.found, f"127.0.0.1, port {port} (for lab)")
    assert "rtc3d.ports.lab" in finding.remedy


def test_an_address_of_another_computer_fails() -> None:
    assert findings(["lab"], {"lab": free_port()}, host="192.0.2.1")[-1].result is Result.FAILING


async def test_the_port_of_a_running_gateway_passes(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with Simulator(CountingScene()) as server:
        *_, finding = await asyncio.to_thread(findings, ["lab"], {"lab": server.port})
        await wait_until_async(lambda: "disconnected" in caplog.text)
    assert "reset" not in caplog.text
    assert (finding.result, "gateway" in finding.found) == (Result.PASSING, True)
