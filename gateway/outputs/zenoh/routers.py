"""The Zenoh routers between gateways and this computer, as they describe themselves.

A router answers queries on ``@/ZID/router`` about itself and its connections: zenohd always, others with
``adminspace: {enabled: true}``. Access control may deny it. Anybody can answer, so everything is bounded.
"""

import json
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import zenoh

from gateway.runtime.safe_text import safe_text

ROUTERS: Final = "@/*/router"
DESCRIPTIONS: Final = f"{ROUTERS}?_stats=true"
"""What to query for the descriptions of all routers, with what they count if they do."""

_MAX_ROUTERS: Final = 64
_MAX_ANSWER_BYTES: Final = 1024 * 1024
"""A router with 1000 connections describes itself in 0.3 MB."""


class Dropped(NamedTuple):
    """How many messages a router has not sent to another side of a link, since the link was opened.

    ``congested``: they were published faster than the link takes them. ``thinned``: rules for the rate or
    the size of messages (downsampling, low_pass_filter) leave them out.
    """

    congested: int
    thinned: int


class Router(NamedTuple):
    """A router. ``name`` is ``metadata.name`` of its configuration, or an address, or its Zenoh id.

    ``routers`` and ``others`` are the Zenoh ids of the routers, and of the peers and clients, that are
    connected to it. ``dropped`` is by the Zenoh id of the other side; only a zenohd that was built with
    ``--features zenoh/stats`` counts.
    """

    zid: str
    name: str
    version: str
    routers: frozenset[str]
    others: frozenset[str]
    dropped: Mapping[str, Dropped]


class RouterNetwork:
    """The routers that a session can reach, from their answers."""

    def __init__(self, session: zenoh.Session) -> None:
        self._peers = {str(zid) for zid in session.info.peers_zid()}
        self._addresses = _addresses(session)
        self.own = str(session.info.zid())
        """The Zenoh id of the session."""
        self.connected: tuple[str, ...] = tuple(self._addresses)
        """The Zenoh ids of the routers to which the session is connected."""
        self.routers: dict[str, Router] = {}
        """The routers that have answered, by their Zenoh ids."""

    def add(self, reply: zenoh.Reply) -> None:
        """Take an answer to ROUTERS. What is no description of a router is left out."""
        sample = reply.ok
        if sample is None or len(sample.payload) > _MAX_ANSWER_BYTES or len(self.routers) >= _MAX_ROUTERS:
            return
        try:
            description = json.loads(sample.payload.to_bytes())
            router = self._router(description)
        except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
            return
        if str(sample.key_expr) == f"@/{router.zid}/router":
            self.routers[router.zid] = router

    def _router(self, description: Any) -> Router:
        zid = str(description["zid"])
        links = {str(each["peer"]): each for each in description["sessions"]}
        metadata = description.get("metadata")
        names = [metadata.get("name") if isinstance(metadata, dict) else None, self._addresses.get(zid)]
        name = next((each for each in [*names, *description["locators"]] if each), zid[:8])
        return Router(
            zid,
            safe_text(str(name), 64),
            safe_text(str(description["version"]).partition("-")[0].removeprefix("v"), 32),
            frozenset(peer for peer, link in links.items() if link["whatami"] == "router"),
            frozenset(peer for peer, link in links.items() if link["whatami"] != "router"),
            {peer: _dropped(link["stats"]) for peer, link in links.items() if "stats" in link},
        )

    def name_of(self, zid: str) -> str:
        """Return what to call a router to which the session is connected."""
        router = self.routers.get(zid)
        return router.name if router is not None else self._addresses.get(zid) or zid[:8]

    @property
    def silent(self) -> list[str]:
        """The names of the routers to which the session is connected that have not answered."""
        return [self.name_of(zid) for zid in self.connected if zid not in self.routers]

    def way_from(self, gateway: str) -> list[Router] | None:
        """Return the routers between a gateway and the session, the gateway's first: the shortest way.

        ``gateway`` is the id of the gateway's Zenoh session. Returns [] if both are connected directly, and
        None if the way is not known.
        """
        if gateway in self._peers:
            return []
        ways = {zid: [self.routers[zid]] for zid in self.connected if zid in self.routers}
        waiting = deque(ways.values())
        while waiting:
            way = waiting.popleft()
            if gateway in way[0].others:
                return way
            for zid in way[0].routers & self.routers.keys():
                if zid not in ways:
                    ways[zid] = [self.routers[zid], *way]
                    waiting.append(ways[zid])
        return None

    def names_from(self, gateway: str) -> list[str] | None:
        """Return the names of these routers."""
        way = self.way_from(gateway)
        return None if way is None else [router.name for router in way]

    def reachable_from(self, zid: str, *, without: str = "") -> set[str]:
        """Return the Zenoh ids of a router and of those behind it, not going through ``without``."""
        found = {without}
        waiting = [zid]
        while waiting:
            zid = waiting.pop()
            if zid not in found:
                found.add(zid)
                waiting += self.routers[zid].routers if zid in self.routers else ()
        return found - {without}


def read_routers(session: zenoh.Session, timeout_s: float) -> RouterNetwork:
    """Return the routers that answer within ``timeout_s``. It takes as long only if one does not."""
    network = RouterNetwork(session)
    if network.connected:
        for reply in session.get(DESCRIPTIONS, consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s):
            network.add(reply)
    return network


def _dropped(counts: Any) -> Dropped:
    thinned = counts["tx_downsampler_dropped_msgs"] + counts["tx_low_pass_dropped_msgs"]
    return Dropped(int(counts["tx_n_dropped"]), int(thinned))


def _addresses(session: zenoh.Session) -> dict[str, str]:
    """Return the address of each router to which the session is connected, by its Zenoh id."""
    found = {str(zid): "" for zid in session.info.routers_zid()}
    for link in session.info.links():
        if str(link.zid) in found:
            found[str(link.zid)] = str(link.dst)
    return found
