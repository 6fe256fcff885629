"""The doctor's checks of the output for RTC3D clients: the names of the sources, and their ports."""

import socket
from collections.abc import Sequence
from typing import Final

from gateway.outputs.findings import Check, Finding, MessageLoad
from gateway.outputs.listen_address import from_this_computer, listen_problem
from gateway.outputs.rtc3d.settings import RTC3D, Rtc3dSettings
from gateway.rtc3d.commands import Version, encode_command
from gateway.rtc3d.packets import PACKET_HEADER, PACKET_HEADER_BYTES, PacketType, encode_packet

_MAX_REPLY_BYTES: Final = 64 * 1024

_SOURCES, _PORTS = (Check("rtc3d", name) for name in RTC3D.checks)


def check_rtc3d(
    settings: Rtc3dSettings, sources: Sequence[str], _loads: Sequence[MessageLoad], seconds: float
) -> list[Finding]:
    """Check that each port belongs to a source, and is free or has the gateway's own RT server."""
    ports = [_check_port(settings.host, source, port, seconds) for source, port in settings.ports.items()]
    return [_check_sources(settings, sources), *(ports or [_PORTS.not_tested("rtc3d.ports is empty")])]


def _check_sources(settings: Rtc3dSettings, sources: Sequence[str]) -> Finding:
    unknown = [source for source in settings.ports if source not in sources]
    if unknown:
        return _SOURCES.warning(
            f"rtc3d.ports has a port for {', '.join(unknown)}, which is no source",
            f"Correct the name; the sources are {', '.join(sources)}.",
        )
    missing = [source for source in sources if source not in settings.ports]
    if missing:
        return _SOURCES.note(
            f"RTC3D clients cannot connect to {', '.join(missing)}",
            "If they should, add a port in rtc3d.ports.",
        )
    return _SOURCES.passing("each source has a port for RTC3D clients")


def _check_port(host: str, source: str, port: int, seconds: float) -> Finding:
    place = f"{host}, port {port} (for {source})"
    problem = listen_problem(host, port)
    if not problem:
        return _PORTS.passing(f"{place} is free")
    if _is_rt_server(host, port, seconds):
        return _PORTS.passing(f"an RT server answers on {place}: the gateway, if it runs")
    return _PORTS.failing(
        f"cannot listen on {place}: {problem}",
        f"Choose another port in rtc3d.ports.{source}, correct rtc3d.host, or stop the program that has it.",
    )


def _is_rt_server(host: str, port: int, seconds: float) -> bool:
    """Return whether a server on this port answers a command of the protocol."""
    command = encode_packet(PacketType.COMMAND, encode_command(Version()))
    try:
        with socket.create_connection((from_this_computer(host), port), timeout=seconds) as tcp:
            tcp.sendall(command)
            header = tcp.recv(PACKET_HEADER_BYTES, socket.MSG_WAITALL)
            if len(header) < PACKET_HEADER_BYTES:
                return False
            size, packet_type = PACKET_HEADER.unpack(header)
            if packet_type not in {PacketType.ERROR, PacketType.COMMAND}:
                return False
            if not PACKET_HEADER_BYTES <= size <= _MAX_REPLY_BYTES:
                return False
            # The whole reply, because closing a connection with unread bytes resets it.
            tcp.recv(size - PACKET_HEADER_BYTES, socket.MSG_WAITALL)
    except OSError:
        return False
    return True
