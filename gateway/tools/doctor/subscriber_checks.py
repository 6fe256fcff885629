"""Checks of the way from gateways to this computer, made as a subscriber: they need no configuration."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from typing import Final

import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.reception import Messages
from gateway.client.sources import ReceivedSource
from gateway.client.transport import GatewaySubscriber
from gateway.errors import ConfigError, OutputError, QueryError
from gateway.messages.source_report import SourceReport
from gateway.outputs.findings import Check, Finding, Result, failing_first
from gateway.outputs.zenoh.checks import AFTER_LINK, GATEWAY, LINK, no_session
from gateway.outputs.zenoh.router_checks import carried, check_links, check_routers, why_absent
from gateway.outputs.zenoh.routers import RouterNetwork, read_routers
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources, subscriber_config
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_text

_ANSWER_S: Final = 2.0
"""How long routers and gateways may take to answer."""

_REFILL_S: Final = 5.0
"""How long to wait after the watch for what was missed."""

_POLL_S: Final = 0.05
_MAX_KEYS: Final = 8
"""How many keys that cross a link are named."""

_THINNED_SHARE: Final = 0.5
"""If more than this share is missing, a rule for the rate is more likely than a bad link."""


def run_subscriber_checks(
    address: GatewayAddress, wanted: Sequence[str], seconds: float
) -> Iterator[Finding]:
    """Check the link, the routers, the gateways, and the data of the ``wanted`` sources (all, if empty).

    The data are watched for ``seconds``. Yields each finding as soon as it is known.
    """
    if address.is_lcm:
        yield from _check_data(address, wanted, seconds)
        return
    try:
        config = subscriber_config(address.connect, address.zenoh_config)
    except ConfigError as error:
        yield from failing_first(LINK.failing(str(error), "Correct this file."), AFTER_LINK)
        return
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        yield from failing_first(no_session(error, config), AFTER_LINK)
        return
    prefix = address.prefix or DEFAULT_ZENOH_PREFIX
    with contextlib.closing(session):
        served = _served(session, prefix)
        network = read_routers(session, _ANSWER_S)
        yield _link_finding(session, network)
        yield from check_routers(network)
        finding = _gateway_finding(session, network, prefix, served, wanted)
        yield finding
        if finding.result is Result.FAILING:
            return
        gateways = _gateways(session, prefix)
        for gateway in gateways:
            for link, keys in carried(session, network, network.way_from(gateway) or [], _ANSWER_S):
                yield _carried_finding(link, keys)
        yield from _check_data(address, wanted, seconds)
        yield from check_links(network, read_routers(session, _ANSWER_S), gateways)


def _link_finding(session: zenoh.Session, network: RouterNetwork) -> Finding:
    num_peers = len(session.info.peers_zid())
    others = [network.name_of(zid) for zid in network.connected]
    others += [counted(num_peers, "peer")] if num_peers else []
    return LINK.passing(f"the session is open, with links to {', '.join(others) or 'nobody'}")


def _gateway_finding(
    session: zenoh.Session,
    network: RouterNetwork,
    prefix: str,
    served: Sequence[str],
    wanted: Sequence[str],
) -> Finding:
    missing = [name for name in wanted if name not in served]
    if served and not missing:
        return GATEWAY.passing(f"gateways serve {', '.join(map(safe_text, served))}")
    absence = why_absent(session, network, prefix, missing, _ANSWER_S)
    if absence is not None:
        return GATEWAY.failing(absence.reason, absence.remedy)
    return GATEWAY.failing(
        no_gateway_on_zenoh(prefix, wanted, served).partition("; ")[0],
        "Check that it runs with this prefix. Multicast finds only computers in the same network: for "
        "others, name the address of a router with --connect.",
    )


def _carried_finding(link: str, keys: Sequence[str]) -> Finding:
    more = f" and {len(keys) - _MAX_KEYS} more" if len(keys) > _MAX_KEYS else ""
    return Check("zenoh", "carried").note(f"{link}: {', '.join(keys[:_MAX_KEYS]) or 'nothing'}{more}")


def _served(session: zenoh.Session, prefix: str) -> list[str]:
    end_s = time.monotonic() + _ANSWER_S
    while not (served := served_sources(session, prefix)) and time.monotonic() < end_s:
        time.sleep(_POLL_S)
    return served


def _gateways(session: zenoh.Session, prefix: str) -> set[str]:
    """Return the Zenoh ids of the gateways."""
    replies = session.get(f"{prefix}/*/status", consolidation=zenoh.ConsolidationMode.NONE, timeout=_ANSWER_S)
    return {str(each.replier_id.zid) for each in replies if each.ok is not None and each.replier_id}


def _check_data(address: GatewayAddress, wanted: Sequence[str], seconds: float) -> Iterator[Finding]:
    """Receive for ``seconds``, fetch what is missing, and check each source."""
    reception = Messages(lambda *_: None)
    try:
        with GatewayClient(address) as client:
            with contextlib.closing(client.subscribe(wanted, None, reception, complete=True)) as subscriber:
                _receive(subscriber, reception, seconds)
            found = client.sources()
    except (OutputError, QueryError) as error:
        yield Check("lcm" if address.is_lcm else "zenoh", "link").problem(str(error))
        return
    if found.absence:
        yield Check("lcm" if address.is_lcm else "zenoh", "gateway").problem(found.absence)
    reports = {each.name: each for each in found.sources}
    received = {source.name: source for source in reception.sources_now}
    for name in wanted or reports:
        yield _data_finding(reports.get(name, SourceReport(name)), received.get(name), seconds)


def _receive(subscriber: GatewaySubscriber, reception: Messages, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        time.sleep(_POLL_S)
        subscriber.tick()
    if (refill := reception.refill) is not None:
        refill.end()
        end_s = time.monotonic() + _REFILL_S
        while refill.num_incomplete and time.monotonic() < end_s:
            time.sleep(_POLL_S)


def _data_finding(report: SourceReport, source: ReceivedSource | None, seconds: float) -> Finding:
    """Return what arrived of a source, and what was missing on the way."""
    check = Check(report.name, "data")
    all_series = [] if source is None else [each for each in source.series if each.has_data]
    num_messages = sum(each.num_messages for each in all_series)
    num_bytes = sum(each.num_bytes for each in all_series)
    num_refilled = sum(each.completion.num_refilled for each in all_series if each.completion)
    num_lost = sum(each.check.num_lost for each in all_series)
    if not num_messages:
        if not any(stream.state == "streaming" for stream in report.streams):
            return check.not_tested(f"its gateway receives no frames: {report.text or report.problem}")
        return check.failing(
            f"its gateway receives frames, but no message arrives here within {seconds:g} s",
            "Look at the rules of the routers for these keys: access control, downsampling, low-pass filter.",
        )
    num_missed = num_refilled + num_lost
    amount = f"{num_messages - num_refilled} messages in {seconds:g} s, {num_bytes / seconds / 1e6:.2f} MB/s"
    if not num_missed:
        return check.passing(f"{amount}, none missing")
    fetched = "all of them" if not num_lost else str(num_refilled) if num_refilled else "none of them"
    cause = "A link or a program on the way is too slow now and then."
    if num_missed > _THINNED_SHARE * (num_messages + num_lost):
        cause = "A router thins them out (downsampling), or a link is much too slow."
    where = f" Run this at each of {' → '.join(report.routers)} to see which." if report.routers else ""
    return check.warning(
        f"{amount}; {num_missed} are missing, of which the gateway's history has {fetched}",
        f"{cause}{where} Programs that must miss nothing fetch them: record, or complete=True in Python.",
    )
