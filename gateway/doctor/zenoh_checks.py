"""Looks at the Zenoh side: whether a session opens, whom it reaches, and whether a gateway is seen.

The doctor's session has the gateway's configuration, but listens to nobody: the addresses may be those
of a gateway that runs. It connects to them instead.
"""

import json
import re
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import zenoh

from gateway.config.secrets import mask_secrets_in_text
from gateway.config.settings import ZenohSettings
from gateway.config.values import zenoh_reason
from gateway.doctor.finding import Finding, Patient
from gateway.errors import ConfigError
from gateway.messages.topics import zenoh_key
from gateway.outputs.zenoh.output import zenoh_config

CHECKS: Final = ("link", "gateway")

_ROUTER_REMEDY: Final = (
    "Start zenohd there, or correct connect/endpoints in zenoh.config; with TLS, certificates must be by "
    "one authority, not have ended, and name the address."
)
_ANY_ADDRESS: Final = re.compile(r"/(\[::\]|0\.0\.0\.0):")
_POLL_S: Final = 0.05

_patient: Final = Patient("zenoh")


def examine_zenoh(settings: ZenohSettings, sources: Sequence[str], seconds: float) -> list[Finding]:
    """Return the findings; blocks for ``seconds`` or a little more."""
    if not settings.enabled:
        return [_patient.untested(check, "zenoh.enabled is false") for check in CHECKS]
    try:
        asked = zenoh_config(settings.config)
    except ConfigError as error:
        return _no_link(mask_secrets_in_text(str(error)), "Correct zenoh.config.")
    mode = json.loads(asked.get_json("mode")) or "peer"
    connect = _endpoints(asked, "connect", mode)
    listen = [endpoint for endpoint in _endpoints(asked, "listen", mode) if not endpoint.endswith(":0")]
    quiet = zenoh_config(settings.config)
    quiet.insert_json5("listen/endpoints", "[]")
    timeout_ms = str(round(1000 * seconds))
    for key in ("connect/timeout_ms", "scouting/timeout", "transport/unicast/open_timeout"):
        quiet.insert_json5(key, timeout_ms)
    if mode != "client":
        reachable = [_ANY_ADDRESS.sub("/127.0.0.1:", endpoint) for endpoint in listen]
        quiet.insert_json5("mode", '"peer"')
        quiet.insert_json5("connect/endpoints", json.dumps([*connect, *reachable]))
        quiet.insert_json5("connect/exit_on_failure", "false")
    keys = {source: zenoh_key(settings.prefix, source, "alive") for source in sources}
    try:
        session = zenoh.open(quiet)
    except zenoh.ZError as error:
        return _no_link(f"the session does not open: {zenoh_reason(error)}", _ROUTER_REMEDY)
    try:
        alive = _wait_for_gateway(session, keys, seconds)
        others = len(session.info.routers_zid()), len(session.info.peers_zid())
    finally:
        session.close()
    if mode != "client" and not any(others) and connect:
        return _no_link(
            f"nobody is reached at {mask_secrets_in_text(', '.join(connect))}, so nothing leaves",
            _ROUTER_REMEDY,
        )
    if listen and not alive and (problem := _cannot_listen(asked, listen)):
        return _no_link(
            problem,
            "Another program has the address: `ss -ltnp` shows which. End it, or change listen/endpoints in "
            "zenoh.config.",
        )
    return [_patient.good("link", _reached(mode, *others)), _seen(alive, sources)]


def _no_link(found: str, remedy: str) -> list[Finding]:
    return [_patient.bad("link", found, remedy), _patient.untested("gateway", "it needs link, which failed")]


def _endpoints(config: zenoh.Config, side: str, mode: str) -> list[str]:
    """Return the endpoints of one side, connect or listen, for ``mode``."""
    configured = json.loads(config.get_json(f"{side}/endpoints"))
    if isinstance(configured, dict) and "locators" not in configured:
        configured = configured.get(mode) or []
    return list(_flat(configured))


def _flat(endpoints: Any) -> Iterator[str]:
    match endpoints:
        case str():
            yield endpoints
        case {"locators": locators}:
            yield from _flat(locators)
        case list():
            for endpoint in endpoints:
                yield from _flat(endpoint)


def _wait_for_gateway(session: zenoh.Session, keys: dict[str, str], seconds: float) -> list[str]:
    """Return the sources that a gateway serves, as soon as all are seen, else after ``seconds``."""
    deadline_s = time.monotonic() + seconds
    while True:
        alive = [
            source
            for source, key in keys.items()
            if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=seconds))
        ]
        if len(alive) == len(keys) or time.monotonic() >= deadline_s:
            return alive
        time.sleep(_POLL_S)


def _cannot_listen(asked: zenoh.Config, listen: Sequence[str]) -> str:
    """Return why nobody could listen as configured; "" if the gateway could."""
    asked.insert_json5("connect/endpoints", "[]")
    asked.insert_json5("listen/exit_on_failure", "true")
    try:
        zenoh.open(asked).close()
    except zenoh.ZError as error:
        return f"nobody can listen on {mask_secrets_in_text(', '.join(listen))}: {zenoh_reason(error)}"
    return ""


def _reached(mode: str, routers: int, peers: int) -> str:
    if mode == "client":
        return "the session is open, with a router"
    return f"the session is open; {routers} router(s) and {peers} peer(s) are reached"


def _seen(alive: Sequence[str], sources: Sequence[str]) -> Finding:
    missing = [source for source in sources if source not in alive]
    if not missing:
        return _patient.good("gateway", f"a gateway serves {', '.join(sources)}")
    return _patient.untested(
        "gateway",
        f"no gateway is seen that serves {', '.join(missing)}; if one runs, its zenoh.prefix or the "
        "router's access rules are others",
    )
