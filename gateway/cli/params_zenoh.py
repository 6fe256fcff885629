"""Parameter queries on Zenoh."""

import contextlib
import json
import math
from collections.abc import Callable

import zenoh

from gateway.cli.gateway_queries import TimeLimits
from gateway.cli.params_query import ParametersReply, Replies, Sections
from gateway.cli.zenoh_client import ZenohClient, ZenohReply
from gateway.errors import OutputError, QueryError
from gateway.messages.topics import zenoh_key


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
