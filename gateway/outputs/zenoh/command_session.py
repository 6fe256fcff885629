"""The configuration of the sessions of ``doctor``, ``echo`` and ``params``, made from that of a gateway."""

import json
import re
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import zenoh

from gateway.outputs.zenoh.config import zenoh_config

_ANY_ADDRESS: Final = re.compile(r"/(\[::\]|0\.0\.0\.0):")
_TLS: Final = "transport/link/tls"


def command_config(given: Path | Mapping[str, Any]) -> zenoh.Config:
    """Return the configuration of a session beside a gateway that uses ``given``; it may be a viewer's, too.

    The session does not listen, because a running gateway may already use the addresses. It connects to
    them instead, and shows the certificate that the gateway shows there. Rules for access control stay with
    the gateway: they would deny this session what its peers may do. Raises ConfigError if Zenoh does not
    accept ``given``.
    """
    config = zenoh_config(given)
    listen = [endpoint for endpoint in endpoints(config, "listen") if not endpoint.endswith(":0")]
    mode = mode_of(config)
    config.insert_json5("access_control", '{"enabled": false, "default_permission": "allow"}')
    if json.loads(config.get_json("id")):  # two sessions with one id do not connect
        # Zenoh rejects an id that begins with 0.
        config.insert_json5("id", json.dumps(f"1{secrets.token_hex(15)}"))
    if mode != "client":
        connect = endpoints(config, "connect")
        reachable = [_ANY_ADDRESS.sub("/127.0.0.1:", endpoint) for endpoint in listen]
        if not connect and reachable != listen:  # a certificate need not contain the loopback address
            config.insert_json5(f"{_TLS}/verify_name_on_connect", "false")
        config.insert_json5("connect/endpoints", json.dumps([*connect, *reachable]))
        config.insert_json5("connect/exit_on_failure", "false")
        config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    _show_certificate(config)
    return config


def _show_certificate(config: zenoh.Config) -> None:
    """Use the certificate for incoming links in outgoing links, too, if there is none for them."""
    tls = json.loads(config.get_json(_TLS))
    if tls["connect_certificate"] or not tls["listen_certificate"]:
        return
    for name in ("certificate", "private_key"):
        config.insert_json5(f"{_TLS}/connect_{name}", json.dumps(tls[f"listen_{name}"]))


def mode_of(config: zenoh.Config) -> str:
    """Return the mode: client, peer or router."""
    return str(json.loads(config.get_json("mode")) or "peer")


def endpoints(config: zenoh.Config, side: str) -> list[str]:
    """Return the configured endpoints for the mode; ``side`` is connect or listen."""
    configured = json.loads(config.get_json(f"{side}/endpoints"))
    if isinstance(configured, dict) and "locators" not in configured:
        configured = configured.get(mode_of(config)) or []
    return list(_flat(configured))


def _flat(configured: Any) -> Iterator[str]:
    match configured:
        case str():
            yield configured
        case {"locators": locators}:
            yield from _flat(locators)
        case list():
            for endpoint in configured:
                yield from _flat(endpoint)
