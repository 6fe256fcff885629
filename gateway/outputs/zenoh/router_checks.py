"""The doctor's checks of Zenoh's routers, and of what they let through to this computer."""

import contextlib
import json
from collections.abc import Iterable, Sequence
from itertools import pairwise
from operator import sub
from typing import Final, NamedTuple

import zenoh

from gateway.outputs.findings import Check, Finding
from gateway.outputs.zenoh.routers import ROUTERS, Dropped, Router, RouterNetwork
from gateway.runtime.safe_text import safe_text

_ROUTERS, _LINKS = Check("zenoh", "routers"), Check("zenoh", "links")

_OLDEST: Final = (1, 9)
"""The first version with regions. Older routers do not pass on everything that newer ones announce."""

_MAX_KEYS: Final = 100
"""How many keys of the routers' answers are read."""

_MAX_ANSWER_BYTES: Final = 64 * 1024


class Absence(NamedTuple):
    """Why no gateway is found, and what to do. ``is_hidden``: a router knows one, but does not show it."""

    reason: str
    remedy: str
    is_hidden: bool = False


def check_routers(network: RouterNetwork) -> list[Finding]:
    """Check the routers to which the session is connected, and those behind them; [] without any."""
    if not network.connected:
        return []
    findings = [
        _ROUTERS.note(
            f"{name} does not describe itself, so what is behind it is not known",
            "Its access control denies it. To let this computer see routers and links, allow it to query "
            "@/** there.",
        )
        for name in network.silent
    ]
    first, *others = network.connected
    reached = network.reachable_from(first)
    findings += [
        _ROUTERS.warning(
            f"the routers {network.name_of(first)} and {network.name_of(zid)} have no link with each other, "
            "so subscribers of one do not get what gateways publish at the other",
            "Name one of them in connect/endpoints of the other. Routers do not look for each other.",
        )
        for zid in others
        if zid not in reached and {first, zid} <= network.routers.keys()
    ]
    findings += [
        _ROUTERS.warning(
            f"the router {router.name} runs Zenoh {router.version}",
            "Use version 1.10 or newer on all routers.",
        )
        for router in network.routers.values()
        if (version := _version(router)) is not None and version < _OLDEST
    ]
    known = [network.routers[zid] for zid in network.connected if zid in network.routers]
    if known:
        findings.append(_ROUTERS.passing("; ".join(_described(router, network) for router in known)))
    return findings


def _described(router: Router, network: RouterNetwork) -> str:
    linked = sorted(network.name_of(zid) for zid in router.routers)
    text = f"connected to {router.name} (Zenoh {router.version})"
    return f"{text}, which is linked with {', '.join(linked)}" if linked else text


def _version(router: Router) -> tuple[int, int] | None:
    major, _, rest = router.version.partition(".")
    minor = rest.partition(".")[0]
    return (int(major), int(minor)) if major.isdecimal() and minor.isdecimal() else None


def why_absent(
    session: zenoh.Session, network: RouterNetwork, prefix: str, sources: Sequence[str], timeout_s: float
) -> Absence | None:
    """Return why no gateway with these sources (all, if empty) is found; None if routers do not show it."""
    for router, key, _ in _answers(session, network, f"token/{prefix}/*/alive", timeout_s):
        source = key.removeprefix(f"token/{prefix}/").removesuffix("/alive")
        if not sources or source in sources:
            return Absence(
                f"the router {router.name} knows a gateway that serves {safe_text(source)}, but does not "
                "show it to this computer",
                f"Its access control, or that of a router between, denies it: allow liveliness_token, "
                f"liveliness_query and the other messages for {prefix}/** to this computer.",
                is_hidden=True,
            )
    what = f"gateway that serves {', '.join(map(safe_text, sources))}" if sources else "gateway"
    if network.silent:
        return Absence(
            f"found no {what} behind {', '.join(network.silent)}, whose access control may hide it",
            f"Check that the gateway runs, and that this computer may use {prefix}/** there.",
        )
    alone = [router.name for router in network.routers.values() if not router.routers]
    if alone and len(alone) == len(network.routers):
        return Absence(
            f"no {what} is connected to {', '.join(alone)}, which has no link with another router",
            "If the gateway is at another site, name that site's router in connect/endpoints of this one. "
            "Otherwise, check that the gateway runs and connects to this router.",
        )
    return None


def carried(
    session: zenoh.Session, network: RouterNetwork, way: Sequence[Router], timeout_s: float
) -> list[tuple[str, list[str]]]:
    """Return what crosses each link between the routers of a way, in its order.

    It is a text such as "site-a → site-b", and the key expressions of the subscribers behind the link.
    """
    found = []
    answers = _answers(session, network, "subscriber/**", timeout_s)
    for router, next_router in pairwise(way):
        behind = network.reachable_from(next_router.zid, without=router.zid)
        keys = {
            safe_text(answer.key.removeprefix("subscriber/"))
            for answer in answers
            if answer.router is router and answer.from_routers & behind and "/@" not in answer.key
        }
        found.append((f"{router.name} → {next_router.name}", sorted(keys)))
    return found


def check_links(before: RouterNetwork, after: RouterNetwork, gateways: Iterable[str]) -> list[Finding]:
    """Check what the routers dropped meanwhile on the ways from ``gateways`` to the session: see Dropped.

    Returns [] if they do not count.
    """
    findings = {}
    for gateway in gateways:
        way = after.way_from(gateway) or []
        zids = [*(each.zid for each in way), after.own]
        for router, next_zid in zip(way, zids[1:], strict=True):
            former = before.routers.get(router.zid, router).dropped.get(next_zid)
            dropped = router.dropped.get(next_zid)
            if former is None or dropped is None:
                continue
            is_here = next_zid == after.own
            link = f"{router.name} → {'this computer' if is_here else after.name_of(next_zid)}"
            findings[link] = _link_finding(link, Dropped(*map(sub, dropped, former)))
    return [*findings.values()]


def _link_finding(link: str, dropped: Dropped) -> Finding:
    thinned = f"{dropped.thinned} messages left out by the router's rules" if dropped.thinned else ""
    if dropped.congested > 0:
        return _LINKS.warning(
            f"{link}: {dropped.congested} messages dropped, because the link is too slow"
            + (f"; {thinned}" if thinned else ""),
            "Let less cross it (max_rate_hz of the gateway, downsampling or access control of the router), "
            "or make it faster.",
        )
    if thinned:
        return _LINKS.note(f"{link}: {thinned} (downsampling, low_pass_filter)")
    return _LINKS.passing(f"{link}: nothing dropped")


class _Answer(NamedTuple):
    """A key that a router has, below its own key, and the routers from which it knows it."""

    router: Router
    key: str
    from_routers: frozenset[str]


def _answers(session: zenoh.Session, network: RouterNetwork, key: str, timeout_s: float) -> list[_Answer]:
    found: list[_Answer] = []
    for reply in session.get(
        f"{ROUTERS}/{key}", consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s
    ):
        if reply.ok is None or len(found) >= _MAX_KEYS or len(reply.ok.payload) > _MAX_ANSWER_BYTES:
            continue
        _, zid, _, rest = str(reply.ok.key_expr).split("/", 3)
        with contextlib.suppress(ValueError, RecursionError, LookupError, TypeError):
            routers = frozenset(json.loads(reply.ok.payload.to_bytes())["routers"])
            if (router := network.routers.get(zid)) is not None:
                found.append(_Answer(router, rest, routers))
    return found
