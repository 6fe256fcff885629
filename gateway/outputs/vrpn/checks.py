"""The doctor's checks of VRPN: the port, and who can connect."""

import socket
from collections.abc import Sequence
from typing import Final

from gateway.errors import system_reason
from gateway.outputs.findings import Check, Finding, MessageLoad
from gateway.outputs.listen_address import from_this_computer, is_loopback
from gateway.outputs.vrpn.protocol import COOKIE_BYTES, COOKIE_START
from gateway.outputs.vrpn.server import bind
from gateway.outputs.vrpn.settings import VRPN, VrpnSettings

_TIMEOUT_S: Final = 2.0

_PORT, _ACCESS = (Check("vrpn", name) for name in VRPN.checks)


def check_vrpn(
    settings: VrpnSettings, _sources: Sequence[str], _loads: Sequence[MessageLoad], _seconds: float
) -> list[Finding]:
    """Check that the port can be used, and say who can connect."""
    return [_check_port(settings), _check_access(settings)]


def _check_port(settings: VrpnSettings) -> Finding:
    where = f"{settings.host}, port {settings.port}"
    try:
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            bind(socket.getaddrinfo(settings.host, settings.port, type=kind), kind).close()
    except OSError as error:
        if _is_served(settings):
            return _PORT.passing(f"a VRPN server answers on {where}")
        return _PORT.failing(
            f"cannot listen on {where}: {system_reason(error)}, and no VRPN server answers there",
            "Stop the program that uses the port, or set vrpn.host and vrpn.port to an address of this "
            "computer and a free port.",
        )
    return _PORT.passing(f"TCP and UDP are free on {where}; no gateway serves VRPN there now")


def _is_served(settings: VrpnSettings) -> bool:
    """Return whether a VRPN server answers on the port."""
    address = (from_this_computer(settings.host), settings.port)
    try:
        with socket.create_connection(address, _TIMEOUT_S) as connection:
            connection.settimeout(_TIMEOUT_S)
            cookie = connection.recv(COOKIE_BYTES, socket.MSG_WAITALL)
    except OSError:
        return False
    return cookie.startswith(COOKIE_START)


def _check_access(settings: VrpnSettings) -> Finding:
    if is_loopback(settings.host):
        return _ACCESS.passing("only programs on this computer can connect")
    return _ACCESS.note(
        f"any computer that reaches {settings.host} can connect: VRPN has no password and no encryption",
        "Open the port in the firewall for the computers that need it, or set vrpn.host to 127.0.0.1.",
    )
