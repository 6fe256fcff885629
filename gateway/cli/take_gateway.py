"""The command ``take`` of gateways, asked on Zenoh or LCM."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import rtc3d
import zenoh

from gateway.cli.gateway_queries import TimeLimits
from gateway.cli.lcm_client import ask_lcm
from gateway.cli.zenoh_client import ZenohClient, ZenohReply
from gateway.errors import OutputError, QueryError
from gateway.messages.topics import zenoh_key
from gateway.outputs.contract import CONTROL_OPTION
from gateway.outputs.lcm.settings import effective_lcm_url
from gateway.outputs.zenoh.subscriber import open_zenoh

COMMAND = "take"


class TakeReplies(NamedTuple):
    """What the gateways replied, by source, and the problems of the others."""

    received: dict[str, dict[str, Any]]
    problems: list[QueryError]


class GatewayAddress(NamedTuple):
    """Where to find gateways, as given by the options of a command. ``source`` None means all of them."""

    source: str | None
    is_lcm: bool
    connect: str | None
    zenoh_config: Path | None
    url: str | None
    queries_url: str | None
    prefix: str | None
    timeout_s: float

    def open_zenoh(self) -> zenoh.Session:
        """Return an open session. Raises QueryError."""
        try:
            return open_zenoh(self.connect, self.zenoh_config)
        except OutputError as error:
            raise QueryError(str(error), code="no-gateway") from error

    def client(self, session: zenoh.Session) -> ZenohClient:
        """Return a client of ``session`` for takes."""
        return ZenohClient(session, self.zenoh_prefix, "takes")

    @property
    def zenoh_prefix(self) -> str:
        """The prefix of keys."""
        return self.prefix or "mocap"

    def selector(self, source: str, options: Mapping[str, str]) -> str:
        """Return the selector for takes of a source."""
        pairs = ";".join(f"{name}={value}" for name, value in options.items())
        return zenoh_key(self.zenoh_prefix, source, COMMAND) + (f"?{pairs}" if pairs else "")

    def ask(self, options: Mapping[str, str]) -> TakeReplies:
        """Ask ``source``, or every source that is found, with these options.

        If all sources are asked and one replies as wanted, those are left out whose gateway records no takes
        and, if takes are to be stopped, those without a running take. Raises QueryError, OutputError.
        """
        replies = self._ask_lcm(options) if self.is_lcm else self._ask_zenoh(options)
        if self.source is None and replies.received:
            expected = {"disabled", "nothing-yet"} if options.get(CONTROL_OPTION) == "stop" else {"disabled"}
            problems = [problem for problem in replies.problems if problem.code not in expected]
            return TakeReplies(replies.received, problems)
        return replies

    def _ask_zenoh(self, options: Mapping[str, str]) -> TakeReplies:
        session = self.open_zenoh()
        received: dict[str, dict[str, Any]] = {}
        client = self.client(session)

        def take(reply: ZenohReply) -> None:
            try:
                received[reply.source] = _content(reply.source, reply.payload)
            except QueryError as error:
                client.problems.append(error)

        try:
            limits = TimeLimits(self.timeout_s)
            sources = client.sources(limits) if self.source is None else [self.source]
            client.query([self.selector(source, options) for source in sources], self.source, limits, take)
        except QueryError as error:
            client.problems.append(error)
        finally:
            session.close()
        return TakeReplies(received, client.problems)

    def _ask_lcm(self, options: Mapping[str, str]) -> TakeReplies:
        request = rtc3d.command_request_t()
        request.command = COMMAND
        request.options = [f"{name}={value}" for name, value in options.items()]
        request.num_options = len(request.options)
        replies = ask_lcm(
            "COMMAND",
            request,
            prefix=self.prefix or "MOCAP",
            source=self.source,
            url=effective_lcm_url(self.url),
            queries_url=self.queries_url,
            timeout_s=self.timeout_s,
        )
        received: dict[str, dict[str, Any]] = {}
        problems = list(replies.problems)
        for source, reply in replies.received.items():
            try:
                received[source] = _content(source, reply.content.encode())
            except QueryError as error:
                problems.append(error)
        return TakeReplies(received, problems)


def _content(source: str, payload: bytes) -> dict[str, Any]:
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise QueryError(f"source {source!r}: the reply about takes cannot be read", code="unreadable")
    return content
