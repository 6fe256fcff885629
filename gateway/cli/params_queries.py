"""Parameter queries on Zenoh and on LCM."""

import contextlib
import json
import math
from collections.abc import Callable
from typing import NamedTuple

import rtc3d
import zenoh

from gateway.cli.gateway_clients import ZenohClient, ZenohReply, ask_lcm
from gateway.cli.gateway_queries import TimeLimits
from gateway.errors import OutputError, QueryError
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import zenoh_key

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


def query_lcm(
    prefix: str,
    source: str | None,
    sections: Sections,
    *,
    fresh: bool,
    url: str,
    queries_url: str | None = None,
    timeout_s: float,
) -> Replies:
    """Request ``sections`` of ``source``, or of every source that is found (None). Raises OutputError."""
    request = rtc3d.parameters_request_t()
    request.sections, request.num_sections = list(sections), len(sections)
    request.fresh = fresh
    replies = ask_lcm(
        "PARAMETERS",
        request,
        prefix=prefix,
        source=source,
        url=url,
        queries_url=queries_url,
        timeout_s=timeout_s,
    )
    received = [
        ParametersReply(name, sections, xml_bytes(reply.xml), reply.age_s, reply.parameters_version)
        for name, reply in replies.received.items()
    ]
    return Replies(received, replies.problems)


def query_zenoh(
    prefix: str,
    source: str | None,
    sections: Sections,
    *,
    fresh: bool,
    open_session: Callable[[], zenoh.Session],
    timeout_s: float,
) -> Replies:
    """Query each of ``sections`` from the gateways that serve ``source``, or from all gateways (None).

    If ``open_session`` raises OutputError, that is one of the problems, not an exception.
    """
    received: list[ParametersReply] = []
    try:
        session = open_session()
    except OutputError as error:
        return Replies(received, [QueryError(str(error), code="no-gateway")])
    key = zenoh_key(prefix, source or "*") + "/parameters"
    keys = [f"{key}/{section}" for section in sections] or [key]
    selectors = [f"{key}?fresh=true" for key in keys] if fresh else keys
    client = ZenohClient(session, prefix, "the parameters")
    try:
        client.query(
            selectors, source, TimeLimits(timeout_s), lambda reply: received.append(_parameters(reply))
        )
    except QueryError as error:
        client.problems.append(error)
    finally:
        session.close()
    return Replies(received, client.problems)


def _parameters(reply: ZenohReply) -> ParametersReply:
    age_s = _fact(reply.attachment, "age_s")
    version = _fact(reply.attachment, "parameters_version")
    return ParametersReply(
        reply.source, reply.path[1:], reply.payload, age_s, None if version is None else int(version)
    )


def _fact(attachment: bytes, name: str) -> float | None:
    """Return a number in the attachment of a reply; None if there is none."""
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        value = float(json.loads(attachment)[name])
        return value if math.isfinite(value) else None
    return None
