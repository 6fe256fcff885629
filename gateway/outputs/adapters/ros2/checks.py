"""The doctor's checks for ROS 2: the router, the gateway's node, other nodes, and the types they expect."""

import itertools
from collections.abc import Sequence
from typing import Final

import zenoh

from gateway.messages.descriptions.labels import printable
from gateway.messages.ros2.encode import NO_HASH, ROS_TYPES
from gateway.outputs.adapters.ros2.output import REMEDY, client_config
from gateway.outputs.adapters.ros2.settings import ROS2, Ros2Settings
from gateway.outputs.adapters.ros2.topic import NODE_NAME, SeenEntity, full_name, seen_entity, tokens_of
from gateway.outputs.findings import Check, Finding, MessageLoad, as_sentence, failing_first
from gateway.outputs.zenoh.checks import is_local
from gateway.outputs.zenoh.config import zenoh_reason

_MAX_NAMED: Final = 8
_MAX_SHOWN_CHARS: Final = 100
_MAX_TOKENS: Final = 100_000

_ROUTER, _GATEWAY, _NODES, _TYPES = (Check("ros2", name) for name in ROS2.checks)


def check_ros2(
    settings: Ros2Settings, _sources: Sequence[str], _loads: Sequence[MessageLoad], seconds: float
) -> list[Finding]:
    """Connect to the router, and look for nodes in the domain. Blocks for about ``seconds`` at most."""
    config = client_config(settings.connect)
    timeout_ms = str(round(1000 * seconds))
    for key in ("connect/timeout_ms", "transport/unicast/open_timeout"):
        config.insert_json5(key, timeout_ms)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        found = f"no Zenoh router at {settings.connect}: {zenoh_reason(error)}"
        return failing_first(_ROUTER.failing(found, as_sentence(REMEDY)), ROS2.checks[1:])
    try:
        replies = session.liveliness().get(tokens_of(settings.domain_id), timeout=seconds)
        first = itertools.islice(replies, _MAX_TOKENS)
        tokens = [str(reply.ok.key_expr) for reply in first if reply.ok is not None]
    finally:
        session.close()
    seen = [each for each in map(seen_entity, tokens) if each is not None]
    names = sorted({each.node for each in seen if not each.topic})
    reached = _ROUTER.passing(f"connected to the router at {settings.connect}")
    own, domain = full_name(settings.namespace, NODE_NAME), f"domain {settings.domain_id}"
    is_visible = _GATEWAY.not_tested(f"the node {own} is not in {domain} now")
    if own in names:
        is_visible = _GATEWAY.passing(f"the node {own} is visible in {domain}")
    return [
        reached,
        is_visible,
        _nodes([name for name in names if name != own], domain),
        _types(seen, settings),
    ]


def _nodes(others: Sequence[str], domain: str) -> Finding:
    if not others:
        return _NODES.note(
            f"no ROS node is visible in {domain}",
            "If nodes are running, check that RMW_IMPLEMENTATION is rmw_zenoh_cpp, that ROS_DOMAIN_ID is "
            f"{domain.removeprefix('domain ')}, and that they use this router.",
        )
    more = f" and {len(others) - _MAX_NAMED} more" if len(others) > _MAX_NAMED else ""
    return _NODES.passing(f"visible in {domain}: {', '.join(map(_shown, others[:_MAX_NAMED]))}{more}")


def _types(seen: Sequence[SeenEntity], settings: Ros2Settings) -> Finding:
    hashes = {each.dds_name: each.hash_in(settings.distribution) for each in ROS_TYPES}
    for each in seen:
        if each.is_subscription and each.type_hash != hashes.get(each.dds_name, each.type_hash):
            remedy = "These nodes get nothing from the gateway. Correct ros2.distribution"
            hint = "humble" if each.type_hash == NO_HASH else "that of the nodes, such as jazzy"
            return _TYPES.warning(
                f"{_shown(each.node)} subscribes to {_shown(each.topic)} with the type hash "
                f"{_shown(each.type_hash)}, which is not that of {settings.distribution}",
                f"{remedy}: {hint}.",
            )
    return _TYPES.passing(f"no node expects other types than those of {settings.distribution}")


def _shown(text: str) -> str:
    """Return a text of a ROS node for people: short, and without control characters."""
    return printable(text[:_MAX_SHOWN_CHARS])


def leaves_host(settings: Ros2Settings) -> bool:
    """Return whether messages may leave this computer: to a router that is not on it."""
    return not is_local(settings.connect)
