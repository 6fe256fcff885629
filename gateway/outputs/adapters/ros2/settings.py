"""The section ``ros2`` of the configuration, and the output in the registry."""

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from gateway.config.section import expects
from gateway.config.settings import OutputSettings
from gateway.config.values import Switch
from gateway.messages.ros2.names import DEFAULT_NAMESPACE
from gateway.outputs.kind import OutputKind, imported_late

MAX_NAMESPACE_CHARS: Final = 100

NAMESPACE: Final = re.compile("[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*(/[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*)*")
"""What a namespace may be, without slashes at both ends."""


DEFAULT_ROUTER: Final = "tcp/127.0.0.1:7447"
"""Where the router of rmw_zenoh listens."""

_ENDPOINT: Final = re.compile(r"(tcp|tls|quic|udp|ws)/(\[[0-9A-Fa-f:.]+\]|[\w.-]{1,253}):(\d{1,5})", re.ASCII)


def _namespace(text: str) -> str:
    name = text.removeprefix("/")
    if name and (len(name) > MAX_NAMESPACE_CHARS or not NAMESPACE.fullmatch(name)):
        raise ValueError
    return name


def _endpoint(text: str) -> str:
    match = _ENDPOINT.fullmatch(text)
    if match is None or not 1 <= int(match[3]) <= 65535:
        raise ValueError
    return text


Namespace = Annotated[
    str,
    AfterValidator(_namespace),
    expects(
        "a ROS namespace such as mocap or site/mocap: letters, digits and single '_', each part beginning "
        f"with a letter, {MAX_NAMESPACE_CHARS} characters at most; '' for none"
    ),
]
RouterEndpoint = Annotated[
    str, AfterValidator(_endpoint), expects(f"the endpoint of a Zenoh router, such as {DEFAULT_ROUTER}")
]
Distribution = Annotated[
    Literal["humble", "jazzy", "kilted", "lyrical", "rolling"],
    expects("humble, jazzy, kilted, lyrical or rolling; for a later one rolling"),
]
Durability = Annotated[
    Literal["volatile"], expects("volatile; transient_local would keep old poses for nodes that start later")
]


class Ros2Settings(OutputSettings):
    """The settings of the output for ROS 2."""

    enabled: Switch = False
    """Whether to publish for ROS 2, as a node does that uses rmw_zenoh."""

    domain_id: Annotated[int, Field(strict=True, ge=0, le=232), expects("a whole number from 0 to 232")] = 0
    """The domain: ROS_DOMAIN_ID of the computers with ROS."""

    namespace: Namespace = DEFAULT_NAMESPACE
    """The namespace of the node and its topics, for example /mocap/lab/markers."""

    connect: RouterEndpoint = DEFAULT_ROUTER
    """The Zenoh router that the nodes use (`ros2 run rmw_zenoh_cpp rmw_zenohd`)."""

    distribution: Distribution = "jazzy"
    """The distribution of ROS 2. All since jazzy are alike; humble has no type hashes."""

    reliability: Annotated[Literal["best_effort", "reliable"], expects("best_effort or reliable")] = (
        "best_effort"
    )
    """The reliability that the publishers announce."""

    durability: Durability = "volatile"
    """The durability that the publishers announce. There is only this one: old poses would mislead robots."""

    depth: Annotated[int, Field(strict=True, ge=1, le=10_000), expects("a whole number from 1 to 10000")] = 10
    """The depth of the history that the publishers announce (keep last)."""


ROS2: Final = OutputKind(
    name="ros2",
    settings=Ros2Settings,
    create=imported_late("gateway.outputs.adapters.ros2.output:Ros2Output"),
    checks=("router", "gateway", "nodes", "types"),
    run_checks=imported_late("gateway.outputs.adapters.ros2.checks:check_ros2"),
    leaves_host=imported_late("gateway.outputs.adapters.ros2.checks:leaves_host"),
)
