"""Finding the sources of gateways on Zenoh: by their liveliness tokens, and their status by query."""

import time
from typing import Final

import zenoh

from gateway.cli.found_sources import FoundSources
from gateway.cli.gateway_queries import RETRY_S
from gateway.messages.topics import zenoh_key
from gateway.outputs.discovery import DISCOVERY_S
from gateway.outputs.zenoh.subscriber import served_sources

_ANSWER_S: Final = 2.0
"""How long a gateway may take to reply with its status."""


def find_on_zenoh(session: zenoh.Session, prefix: str, source: str | None = None) -> FoundSources:
    """Return the sources of all gateways that are found, or only ``source``."""
    served = _served(session, prefix)
    wanted = [name for name in served if source in {None, name}]
    found = FoundSources()
    for name in served:
        found.hear(name)
    received: set[tuple[str, str]] = set()
    end_s = time.monotonic() + _ANSWER_S
    while wanted:
        _query(session, zenoh_key(prefix, source or "*", "status"), prefix, found, received)
        silent = set(wanted).difference(name for name, _ in received)
        if not silent or time.monotonic() >= end_s:
            found.add_silent(sorted(silent))
            break
        time.sleep(RETRY_S)
    return found


def _served(session: zenoh.Session, prefix: str) -> list[str]:
    """Return the sources that are served; gateways are found one after the other."""
    end_s = time.monotonic() + DISCOVERY_S
    served: list[str] = []
    while True:
        left_s = end_s - time.monotonic()
        found = sorted({*served, *served_sources(session, prefix, max(1.0, left_s))})
        if found == served != [] or left_s <= 0:
            return found
        served = found
        time.sleep(RETRY_S)


def _query(
    session: zenoh.Session, selector: str, prefix: str, found: FoundSources, received: set[tuple[str, str]]
) -> None:
    """Query every status once. Errors are ignored: the query is repeated."""
    # NONE keeps the replies of all gateways: several may serve sources of the same name.
    for reply in session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=_ANSWER_S):
        if reply.ok is None:
            continue
        name = str(reply.ok.key_expr).removeprefix(f"{prefix}/").partition("/")[0]
        gateway = "" if reply.replier_id is None else str(reply.replier_id.zid)
        if (name, gateway) not in received:
            received.add((name, gateway))
            found.add_status(reply.ok.payload.to_bytes(), name, gateway)
