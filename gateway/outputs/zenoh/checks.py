"""The doctor's checks of Zenoh: does a session open, which routers does it reach, and is a gateway running?

The doctor's session uses the gateway's configuration but does not listen, because a running gateway may
already use the addresses. It connects to them instead.
"""

import json
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import zenoh

from gateway.config.words import mask_secrets_in_text
from gateway.errors import ConfigError
from gateway.messages.topics import zenoh_key
from gateway.outputs.findings import Check, Finding, MessageLoad, failing_first
from gateway.outputs.zenoh.config import command_config, endpoints, mode_of, zenoh_config, zenoh_reason
from gateway.outputs.zenoh.router_checks import Absence, check_routers, why_absent
from gateway.outputs.zenoh.routers import read_routers
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.tls_checks import tls_problem
from gateway.runtime.quantities import counted

_ROUTER_REMEDY: Final = (
    "Start zenohd at that address, or correct connect/endpoints in zenoh.config. With TLS, check that all "
    "certificates come from one authority, have not expired and contain the address."
)
_LOCAL: Final = re.compile(r"unix|(tcp|tls|quic|udp|ws)/(127\.[\d.]+|\[::1\]|localhost):")
"""The beginning of endpoints on this computer."""
_POLL_S: Final = 0.05

LINK, GATEWAY = Check("zenoh", "link"), Check("zenoh", "gateway")
AFTER_LINK: Final = ("routers", "gateway")
"""The checks that need a link."""


def check_zenoh(
    settings: ZenohSettings, sources: Sequence[str], _loads: Sequence[MessageLoad], seconds: float
) -> list[Finding]:
    """Check the session and find gateways that serve ``sources``. Blocks for about ``seconds``."""
    try:
        config = zenoh_config(settings.config)
    except ConfigError as error:
        remedy = "Correct this file." if isinstance(settings.config, Path) else "Correct zenoh.config."
        return _no_link(mask_secrets_in_text(str(error)), remedy)
    mode = mode_of(config)
    connect = endpoints(config, "connect")
    listen = [endpoint for endpoint in endpoints(config, "listen") if not endpoint.endswith(":0")]
    keys = {source: zenoh_key(settings.prefix, source, "alive") for source in sources}
    own_config, timeout_ms = command_config(settings.config), str(round(1000 * seconds))
    for key in ("connect/timeout_ms", "scouting/timeout", "transport/unicast/open_timeout"):
        own_config.insert_json5(key, timeout_ms)
    try:
        session = zenoh.open(own_config)
    except zenoh.ZError as error:
        return failing_first(no_session(error, own_config), AFTER_LINK)
    try:
        served = _find_gateways(session, keys, seconds)
        network = read_routers(session, seconds)
        missing = [source for source in sources if source not in served]
        absence = why_absent(session, network, settings.prefix, missing, seconds) if missing else None
        routers, peers = len(network.connected), len(session.info.peers_zid())
    finally:
        session.close()
    if mode != "client" and not routers and not peers and connect:
        return _no_link(
            f"no router or peer can be reached at {mask_secrets_in_text(', '.join(connect))}, so no data "
            "leaves this computer",
            _ROUTER_REMEDY,
        )
    if listen and not served and (problem := _listen_problem(config, listen)):
        return _no_link(
            problem,
            "Another program uses the address; `ss -ltnp` shows which one. Stop it, or change "
            "listen/endpoints in zenoh.config.",
        )
    others = "a router" if mode == "client" else f"{counted(routers, 'router')} and {counted(peers, 'peer')}"
    link = LINK.passing(f"the session is open and connected to {others}")
    return [link, *check_routers(network), _gateway_finding(sources, missing, absence)]


def no_session(error: zenoh.ZError, config: zenoh.Config) -> Finding:
    """Return the finding that a session with this configuration does not open, and why, as far as known."""
    for endpoint in endpoints(config, "connect"):
        if problem := tls_problem(endpoint, config):
            return LINK.problem(f"the session does not open: {problem}")
    return LINK.failing(f"the session does not open: {zenoh_reason(error)}", _ROUTER_REMEDY)


def _gateway_finding(sources: Sequence[str], missing: Sequence[str], absence: Absence | None) -> Finding:
    if not missing:
        return GATEWAY.passing(f"a gateway serves {', '.join(sources)}")
    if absence is not None and absence.is_hidden:
        return GATEWAY.failing(absence.reason, absence.remedy)
    default = f"found no gateway that serves {', '.join(missing)}; if one is running, check its zenoh.prefix"
    return GATEWAY.not_tested(absence.reason if absence else default)


def leaves_host(settings: ZenohSettings) -> bool:
    """Return whether messages may leave this computer: to endpoints that are not on it, or by multicast."""
    try:
        config = zenoh_config(settings.config)
    except ConfigError:
        return True  # as with the defaults
    used = endpoints(config, "connect") + ([] if mode_of(config) == "client" else endpoints(config, "listen"))
    is_scouting = json.loads(config.get_json("scouting/multicast/enabled")) is not False
    return is_scouting or not all(map(is_local, used))


def is_local(endpoint: str) -> bool:
    """Return whether an endpoint is on this computer."""
    return _LOCAL.match(endpoint) is not None


def _no_link(found: str, remedy: str) -> list[Finding]:
    return failing_first(LINK.failing(found, remedy), AFTER_LINK)


def _find_gateways(session: zenoh.Session, keys: dict[str, str], seconds: float) -> list[str]:
    """Return the sources that a gateway serves. Waits up to ``seconds`` until all are served."""
    deadline_s = time.monotonic() + seconds
    while True:
        served = [
            source
            for source, key in keys.items()
            if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=seconds))
        ]
        if len(served) == len(keys) or time.monotonic() >= deadline_s:
            return served
        time.sleep(_POLL_S)


def _listen_problem(config: zenoh.Config, listen: Sequence[str]) -> str:
    """Return why a gateway could not listen as configured; "" if it could."""
    config.insert_json5("connect/endpoints", "[]")
    config.insert_json5("listen/exit_on_failure", "true")
    try:
        zenoh.open(config).close()
    except zenoh.ZError as error:
        return f"a gateway cannot listen on {mask_secrets_in_text(', '.join(listen))}: {zenoh_reason(error)}"
    return ""
