"""Addresses that servers listen on: who can connect, under which names, and how from this computer."""

import contextlib
import functools
import ipaddress
import re
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from gateway.errors import system_reason
from gateway.runtime.safe_text import quoted

_AUTHORITY: Final = re.compile(
    r"(?:https?://)?(?:\[(?P<ipv6>[\d:.a-f]+)\]|(?P<name>[\w.-]+))(?::(?P<port>\d+))?",
    re.IGNORECASE | re.ASCII,
)
"""The value of Host, or of Origin."""

_RESOLVER: Final = Path("/etc/resolv.conf")

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


def foreign_request(listen_host: str, hosts: Sequence[str], origins: Sequence[str]) -> str:
    """Return why a server that listens on ``listen_host`` must refuse an HTTP request; "" if it need not.

    ``hosts`` and ``origins`` are the values of these headers. A page of a foreign site can have a browser
    connect to this server; the browser then sends the site as Origin. Or the site's own name leads to this
    server's address (DNS rebinding); the browser then sends that name as Host. Other programs send no Origin.
    """
    if len(hosts) > 1 or len(origins) > 1:
        return "the request has more than one Host or Origin"
    host = _AUTHORITY.fullmatch(hosts[0]) if hosts else None
    if hosts and (host is None or not _is_own(host["ipv6"] or host["name"], listen_host)):
        return (
            f"{quoted(hosts[0])} is not a name or address of this server: use its IP address, "
            "or have it listen on that name"
        )
    origin = _AUTHORITY.fullmatch(origins[0]) if origins else None
    if origins and (
        origin is None
        or not _is_own(origin["ipv6"] or origin["name"], listen_host)
        or (host is not None and origin["port"] != host["port"])
    ):
        return f"pages of {quoted(origins[0])} must not use this server"
    return ""


def foreign_page(
    listen_host: str, hosts: Sequence[str], origins: Sequence[str], is_allowed: Callable[[str], bool]
) -> str:
    """Return why a server must not serve a page of another server in a browser; "" if it may.

    Allowed are pages from this server's host or from the browser's own computer, at any port, and origins
    that ``is_allowed``. A request without Origin is from another program.
    """
    if not origins:
        return ""
    origin = _AUTHORITY.fullmatch(origins[0])
    name = "" if origin is None else origin["ipv6"] or origin["name"]
    if len(origins) == 1 and (is_allowed(origins[0]) or _is_own(name, "localhost")):
        return ""
    # Compared with Host, because a browser sends pages of an evil site at another address, too.
    host = _AUTHORITY.fullmatch(hosts[0]) if hosts else None
    is_same = host is not None and name.lower() == (host["ipv6"] or host["name"]).lower() != ""
    if len(origins) == 1 and is_same and not foreign_request(listen_host, hosts, []):
        return ""
    return f"pages of {quoted(origins[0])} must not use this server"


def _is_own(name: str, listen_host: str) -> bool:
    """Return whether a name or address in a request is that of a server on ``listen_host``.

    Nobody can have an IP address in a browser stand for another one.
    """
    name = name.lower().removesuffix(".")
    if name == listen_host.lower() or name.endswith(".localhost") or is_loopback(name):
        return True
    if is_loopback(listen_host):
        return False
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name in _own_names()


@functools.cache
def _own_names() -> frozenset[str]:
    """Return the names of this computer, as far as they are known without asking a name server."""
    full = socket.gethostname().lower()
    short = full.partition(".")[0]
    domains = ["local"]
    with contextlib.suppress(OSError):
        for line in _RESOLVER.read_text(errors="replace").lower().splitlines():
            keyword, *words = line.split() or [""]
            domains += words if keyword in {"search", "domain"} else []
    return frozenset({full, short, *(f"{short}.{domain}" for domain in domains)})
