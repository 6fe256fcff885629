"""The doctor's checks of VRPN."""

import errno
import os
import socket
import threading

from gateway.outputs.adapters.vrpn.output import VrpnOutput, check_vrpn
from gateway.outputs.adapters.vrpn.settings import VRPN, VrpnSettings
from gateway.outputs.findings import Result
from tests.support.errors import names
from tests.support.networks import free_port
from tests.support.waiting import wait_until


def check(settings: VrpnSettings) -> dict[str, tuple[Result, str, str]]:
    findings = check_vrpn(settings, ["lab"], [], 0.1)
    assert [finding.check for finding in findings] == list(VRPN.checks)
    return {finding.check: (finding.result, finding.found, finding.remedy) for finding in findings}


def test_free_port_passes_and_stays_free_and_a_running_gateway_passes() -> None:
    settings = VrpnSettings(enabled=True, port=free_port())
    for _ in range(2):
        result, found, remedy = check(settings)["port"]
        assert (result, remedy) == (Result.PASSING, "")
        assert names(found, "free", f"127.0.0.1, port {settings.port}")
    output = VrpnOutput(settings)
    output.start()
    wait_until(lambda: output.health().connected)
    result, found, remedy = check(settings)["port"]
    output.close()
    assert (result, remedy) == (Result.PASSING, "")
    assert names(found, "answers", f"127.0.0.1, port {settings.port}")


def test_other_server_on_the_port_fails() -> None:
    def answer() -> None:
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        threading.Thread(target=answer, daemon=True).start()
        result, found, remedy = check(VrpnSettings(enabled=True, port=port))["port"]
    assert result is Result.FAILING
    assert names(found, f"127.0.0.1, port {port}", os.strerror(errno.EADDRINUSE), "no VRPN server")
    assert names(remedy, "vrpn.host", "vrpn.port")


def test_port_that_only_udp_uses_fails() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        result, found, _ = check(VrpnSettings(enabled=True, port=other.getsockname()[1]))["port"]
    assert result is Result.FAILING
    assert names(found, os.strerror(errno.EADDRINUSE))


def test_access_is_a_note_if_others_can_connect() -> None:
    settings = VrpnSettings(enabled=True, port=free_port())
    result, found, _ = check(settings.model_copy(update={"host": "0.0.0.0"}))["access"]  # noqa: S104
    assert result is Result.NOTE
    assert names(found, "0.0.0.0")  # noqa: S104 - nothing binds it
    assert check(settings)["access"][0] is Result.PASSING
    assert [VRPN.leaves_host(VrpnSettings(host=host)) for host in ("lab-pc", "localhost")] == [True, False]
