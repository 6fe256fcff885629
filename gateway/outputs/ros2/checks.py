"""The doctor's checks for ROS 2: is the router there, does a gateway publish, and are there ROS nodes?"""

from collections.abc import Sequence
from typing import Final

import zenoh

from gateway.findings import Finding, MessageLoad, Subject
from gateway.outputs.ros2.router import REMEDY, client_config
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.ros2.topic import NODE_NAME
from gateway.outputs.ros2.wire import node_tokens
from gateway.outputs.zenoh.checks import is_local
from gateway.outputs.zenoh.config import zenoh_reason

CHECKS: Final = ("router", "gateway", "nodes")

_MAX_NAMED: Final = 8

_ros2: Final = Subject("ros2")


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
        return [
            _ros2.failing("router", f"no Zenoh router at {settings.connect}: {zenoh_reason(error)}", _REMEDY),
            *(_ros2.not_tested(check, "it needs router, which failed") for check in CHECKS[1:]),
        ]
    try:
        tokens = session.liveliness().get(node_tokens(settings.domain_id), timeout=seconds)
        keys = [str(reply.ok.key_expr) for reply in tokens if reply.ok is not None]
    finally:
        session.close()
    names = sorted({key.rpartition("/")[2] for key in keys})
    reached = _ros2.passing("router", f"connected to the router at {settings.connect}")
    return [reached, _gateway(names, settings), _nodes(names, settings)]


_REMEDY: Final = f"{REMEDY[:1].upper()}{REMEDY[1:]}."


def _gateway(names: Sequence[str], settings: Ros2Settings) -> Finding:
    if NODE_NAME in names:
        return _ros2.passing("gateway", f"the node {NODE_NAME} is visible in domain {settings.domain_id}")
    return _ros2.not_tested(
        "gateway", f"no gateway publishes in domain {settings.domain_id} on this router now"
    )


def _nodes(names: Sequence[str], settings: Ros2Settings) -> Finding:
    others = [name for name in names if name != NODE_NAME]
    if not others:
        return _ros2.note(
            "nodes",
            f"no ROS node is visible in domain {settings.domain_id}",
            "If nodes are running, check that RMW_IMPLEMENTATION is rmw_zenoh_cpp, that ROS_DOMAIN_ID is "
            f"{settings.domain_id}, and that they use this router.",
        )
    shown = ", ".join(others[:_MAX_NAMED]) + (
        f" and {len(others) - _MAX_NAMED} more" if len(others) > _MAX_NAMED else ""
    )
    return _ros2.passing("nodes", f"visible in domain {settings.domain_id}: {shown}")


def leaves_host(settings: Ros2Settings) -> bool:
    """Return whether messages may leave this computer: to a router that is not on it."""
    return not is_local(settings.connect)
