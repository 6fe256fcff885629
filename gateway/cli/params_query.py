"""What parameter queries on Zenoh and on LCM have in common."""

from typing import NamedTuple

from gateway.errors import QueryError

Sections = tuple[str, ...]
"""Keys of SECTIONS (gateway.rtc3d.parameters), such as "3d"; () means all sections."""


class ParametersReply(NamedTuple):
    """The parameters of one source, as XML, reduced to ``sections``.

    ``age_s`` is the time since the gateway received them from the server, and ``version`` the
    ``parameters_version`` of the messages that they describe; None if unknown.
    """

    source: str
    sections: Sections
    xml: bytes
    age_s: float | None
    version: int | None = None


class Replies(NamedTuple):
    """All replies to a query, and the problems; QueryError lists their codes."""

    received: list[ParametersReply]
    problems: list[QueryError]
