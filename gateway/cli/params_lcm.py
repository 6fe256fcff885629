"""Parameter queries on LCM."""

import rtc3d

from gateway.cli.lcm_client import ask_lcm
from gateway.cli.params_query import ParametersReply, Replies, Sections
from gateway.messages.parameters_text import xml_bytes


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
