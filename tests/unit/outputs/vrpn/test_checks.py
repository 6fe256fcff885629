"""The doctor's checks of VRPN."""

import asyncio
import socket

import pytest

from gateway.findings import Result
from gateway.outputs.vrpn.checks import CHECKS, check_vrpn, leaves_host
from gateway.outputs.vrpn.output import VrpnOutput
from gateway.outputs.vrpn.settings import VrpnSettings
from tests.networks import free_port
from tests.waiting import wait_until


def check(settings: VrpnSettings) -> dict[str, tuple[Result, str, str]]:
    findings = check_vrpn(settings, ["lab"], [], 0.1)
    assert [finding.check for finding in findings] == list(CHECKS)
    return {finding.check: (finding.result, finding.found, finding.remedy) for finding in findings}


def test_free_port_passes_and_stays_free() -> None:
    settings = VrpnSettings(enabled=True, port=free_port())
    expected = f"TCP and UDP are free on 127.0.0.1, port {settings.port}; no gateway serves VRPN there now"
    for _ in range(2):
        assert check(settings)["port"] == (Result.PASSING, expected, "")


def test_running_gateway_passes() -> None:
    settings = VrpnSettings(enabled=True, port=free_port())
    output = VrpnOutput(settings)
    output.start()
    wait_until(lambda: output.health().connected)
    found = check(settings)["port"]
    output.close()
    assert found == (Result.PASSING, f"a VRPN server answers on 127.0.0.1, port {settings.port}", "")


async def test_other_server_on_the_port_fails() -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        port = server.sockets[0].getsockname()[1]
        settings = VrpnSettings(enabled=True, port=port)
        result, found, remedy = (await asyncio.to_thread(check, settings))["port"]
    assert result is Result.FAILING
    assert found == (
        f"cannot listen on 127.0.0.1, port {port}: Address already in use, and no VRPN server answers there"
    )
    assert remedy.startswith("Stop the program that uses the port, or set vrpn.host and vrpn.port")


def test_port_that_only_udp_uses_fails() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        result, found, _ = check(VrpnSettings(enabled=True, port=other.getsockname()[1]))["port"]
    assert result is Result.FAILING
    assert "Address already in use" in found


@pytest.mark.parametrize(
    ("host", "reaches_others"),
    [
        ("127.0.0.1", False),
        ("127.0.0.2", False),
        ("::1", False),
        ("localhost", False),
        ("0.0.0.0", True),  # noqa: S104 - the point of this test
        ("192.0.2.5", True),
        ("lab-pc", True),
    ],
)
def test_who_can_connect(host: str, reaches_others: bool) -> None:
    settings = VrpnSettings(enabled=True, host=host, port=free_port())
    assert leaves_host(settings) is reaches_others


def test_access_is_a_note_if_others_can_connect() -> None:
    port = free_port()
    result, found, _ = check(VrpnSettings(enabled=True, host="0.0.0.0", port=port))["access"]  # noqa: S104
    assert result is Result.NOTE
    assert found.startswith("any computer that reaches 0.0.0.0 can connect")
    result, found, _ = check(VrpnSettings(enabled=True, port=port))["access"]
    assert (result, found) == (Result.PASSING, "only programs on this computer can connect")
