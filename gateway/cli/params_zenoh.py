"""Parameter queries on Zenoh."""

import contextlib
import json
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
    return ParametersReply(reply.source, reply.path[1:], reply.payload, _age_s(reply.attachment))


def _age_s(attachment: bytes) -> float | None:
    with contextlib.suppress(ValueError, TypeError, KeyError):
        return float(json.loads(attachment)["age_s"])
    return None
