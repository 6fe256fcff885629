"""The ports that Zenoh opens for the gateway, by its configuration: where it listens, and scouting."""

import json
import re
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import zenoh

from gateway.config.settings import SourceSettings
from gateway.outputs.listen_address import is_loopback
from gateway.outputs.open_ports import Access, OpenPort, control_or
from gateway.outputs.zenoh.config import endpoints, mode_of, zenoh_config
from gateway.outputs.zenoh.settings import ZenohSettings

_PROTOCOLS: Final = {"tcp": "tcp", "tls": "tcp", "ws": "tcp", "quic": "udp", "udp": "udp"}
"""The protocol under each of Zenoh's that has a port."""

_ENCRYPTED: Final = {"tls", "quic"}
_SCOUTING_ADDRESS: Final = "224.0.0.224:7446"
"""Zenoh's default."""

_LISTEN_REMEDY: Final = (
    "Let the gateway be a client of a router that asks for certificates: docs/how-to/secure.md#the-router."
)
_SCOUTING_REMEDY: Final = (
    "Set scouting/multicast/enabled to false in zenoh.config: docs/how-to/secure.md#scouting."
)


class _Protection(NamedTuple):
    """The encryption of a port, and what others must have to connect; see OpenPort."""

    encryption: str = ""
    authentication: str = ""


def open_ports(settings: ZenohSettings, sources: Sequence[SourceSettings]) -> list[OpenPort]:
    """Return where the session listens, and the ports of scouting. Raises ConfigError."""
    ports = _ports(zenoh_config(settings.config))
    return [port._replace(access=control_or(port.access, sources)) for port in ports]


def is_open_to_others(config: zenoh.Config) -> bool:
    """Return whether programs on other computers can get links, without a password or certificate."""
    return any(not is_loopback(port.host) and not port.authentication for port in _ports(config))


def _ports(config: zenoh.Config) -> list[OpenPort]:
    listening = [] if mode_of(config) == "client" else _listen_ports(config)
    return [*listening, *_scouting_ports(config)]


def _listen_ports(config: zenoh.Config) -> Iterator[OpenPort]:
    has_password = json.loads(config.get_json("transport/auth/usrpwd"))["dictionary_file"]
    for endpoint in endpoints(config, "listen"):
        name, _, rest = endpoint.partition("/")
        if name not in _PROTOCOLS:  # such as unixsock-stream
            continue
        encryption, certificates = _tls(config) if name in _ENCRYPTED else _Protection()
        words = [certificates, "password" if has_password else ""]
        yield OpenPort(
            _PROTOCOLS[name],
            *_host_and_port(re.split("[?#]", rest)[0]),
            Access.PUBLISH,
            "peers subscribe, query, and publish under every key",
            _LISTEN_REMEDY,
            encryption=encryption,
            authentication=" and ".join(filter(None, words)),
        )


def _scouting_ports(config: zenoh.Config) -> Iterator[OpenPort]:
    """Yield the ports by which the session finds others and is found; none if it does not search.

    A password protects none of them: Zenoh asks those who connect for it, and not those to whom it connects.
    """
    scouting = json.loads(config.get_json("scouting/multicast"))
    is_client = mode_of(config) == "client"
    if scouting["enabled"] is False or (is_client and endpoints(config, "connect")):
        return
    protocols = set(json.loads(config.get_json("transport/link/protocols")) or _PROTOCOLS)
    encryption, authentication = _tls(config) if protocols <= _ENCRYPTED else _Protection()
    answers = OpenPort(
        "udp",
        "0.0.0.0",  # noqa: S104 - not bound here
        0,
        Access.PUBLISH,
        "the gateway connects to Zenoh peers that answer its search here",
        _SCOUTING_REMEDY,
        encryption=encryption,
        authentication=authentication,
    )
    if not is_client:
        group, port = _host_and_port(scouting["address"] or _SCOUTING_ADDRESS)
        yield answers._replace(
            host=group,
            port=port,
            purpose="Zenoh peers find the gateway and connect, or it connects to them",
            interface=(scouting["interface"] or "auto").replace("auto", ""),
        )
    yield answers


def _host_and_port(address: str) -> tuple[str, int]:
    """Split HOST:PORT. Without a port, which Zenoh notices only when it listens, the port is 0."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port) if port.isdecimal() else 0


def _tls(config: zenoh.Config) -> _Protection:
    """Return what protects a link with TLS."""
    has_certificates = json.loads(config.get_json("transport/link/tls"))["enable_mtls"]
    return _Protection("TLS", "client certificates" if has_certificates else "")
