"""The ports that an output opens, and what peers can do there."""

from collections.abc import Collection, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple

from gateway.config.settings import SourceSettings


class Access(StrEnum):
    """What peers can do at a port; each value includes those before it. They appear in the doctor's JSON."""

    NOTHING = "nothing"
    READ = "read"
    PUBLISH = "publish"
    """Send messages that subscribers take for the gateway's."""

    CONTROL = "control"
    """Start and stop recordings and takes."""


class OpenPort(NamedTuple):
    """A TCP or UDP port that the gateway opens, or a multicast group to which it sends.

    ``host`` is the address or name on which it listens, or the multicast group. ``port`` is 0 if the system
    chooses one at each start. ``purpose`` says what peers find there. ``remedy`` is a sentence that says how
    to keep others out. ``interface`` is where the multicast group is joined; "" means on any. ``encryption``
    and ``authentication`` name what protects the port; "" means nothing does.
    """

    protocol: str
    host: str
    port: int
    access: Access
    purpose: str
    remedy: str
    interface: str = ""
    encryption: str = ""
    authentication: str = ""


FIREWALL: Final = (
    "Open the port in the firewall only for the computers that need it: "
    "docs/how-to/secure.md#ports-without-a-password."
)
"""The remedy for a port whose protocol has no passwords."""


def control_or(access: Access, sources: Collection[SourceSettings]) -> Access:
    """Return CONTROL if peers may control one of the sources, else ``access``."""
    return Access.CONTROL if any(source.remote_control for source in sources) else access


def web_port(host: str, port: int, purpose: str, setting: str) -> OpenPort:
    """Return a port that nginx can protect; ``setting`` names the one that has its host."""
    remedy = (
        f"Leave {setting} at 127.0.0.1, and put nginx with TLS and a password in front: "
        "docs/how-to/secure.md#tls-and-a-password."
    )
    return OpenPort("tcp", host, port, Access.READ, purpose, remedy)


def listening_ports(settings: Any, _sources: Sequence[SourceSettings]) -> list[OpenPort]:
    """Return the TCP ports of an output that does not describe its ports."""
    return [
        OpenPort(
            "tcp",
            address.host,
            address.port,
            Access.READ,
            "clients of this output; it does not describe what they can do",
            FIREWALL,
        )
        for address in settings.listens_on
    ]
