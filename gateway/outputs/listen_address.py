"""Addresses that servers listen on: who can connect, and how to connect from this computer."""

import ipaddress
import socket
from typing import Final

from gateway.errors import system_reason

_OF_THIS_COMPUTER: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - not bound here


def is_loopback(host: str) -> bool:
    """Return whether only programs on this computer can connect to ``host``. A name may be any address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def from_this_computer(host: str) -> str:
    """Return the address to connect to for a server that listens on ``host``, perhaps on all addresses."""
    return _OF_THIS_COMPUTER.get(host, host)


def listen_problem(host: str, port: int) -> str:
    """Return why a server cannot listen on ``port`` at every address of ``host``; "" if it can."""
    try:
        for family, _, _, _, address in socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        ):
            socket.create_server(address, family=family, backlog=1).close()
    except OSError as error:
        return system_reason(error)
    return ""


def host_in_url(host: str) -> str:
    """Return ``host`` as it is written in URLs and before a port: an IPv6 address has brackets."""
    return f"[{host}]" if ":" in host else host
