"""Commands of peers on LCM, such as starting a take: the same as on Zenoh, with replies in JSON."""

import asyncio
from collections import OrderedDict
from typing import Any, Final

import rtc3d

from gateway.errors import QueryError
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION, QueryService
from gateway.outputs.encodings import JSON
from gateway.outputs.lcm.requests import ReplyContent, RequestKind
from gateway.safe_text import quoted

MAX_REMEMBERED: Final = 64
"""How many commands are remembered with their results, for requests that are repeated."""

_Identity = tuple[Any, ...]


class LcmCommands:
    """Answers ``command_request_t`` with ``service``.

    Requests and replies can be lost on LCM, so their senders repeat them. A command that changes something is
    carried out once nevertheless: equal requests get the result of the first.
    """

    def __init__(self, service: QueryService) -> None:
        self.kind = RequestKind("COMMAND", rtc3d.command_request_t, rtc3d.command_reply_t, self._answer_once)
        """The requests that ``service`` answers."""
        self._service = service
        self._remembered: OrderedDict[_Identity, asyncio.Task[ReplyContent]] = OrderedDict()

    def close(self) -> None:
        """Cancel the commands in progress."""
        for task in self._remembered.values():
            task.cancel()

    async def _answer_once(self, source: str, request: Any) -> ReplyContent:
        options = _options(request)
        if CONTROL_OPTION not in options:
            return await self._answer(source, request.command, options)
        identity = (source, request.request_id, request.requester, request.command, *request.options)
        task = self._remembered.get(identity)
        if task is None:
            task = asyncio.create_task(self._answer(source, request.command, options))
            self._remembered[identity] = task
            task.add_done_callback(lambda done: self._finish(identity, done))
        return await asyncio.shield(task)

    def _finish(self, identity: _Identity, task: asyncio.Task[ReplyContent]) -> None:
        """Forget a command that failed, because it may be tried again, and the oldest of too many."""
        if task.cancelled() or task.exception() is not None:
            del self._remembered[identity]
        while len(self._remembered) > MAX_REMEMBERED:
            self._remembered.popitem(last=False)

    async def _answer(self, source: str, command: str, options: dict[str, str]) -> ReplyContent:
        if command not in self._service.commands():
            accepted = ", ".join(self._service.commands())
            raise QueryError(f"unknown command {quoted(command)}; accepted on LCM: {accepted}")
        if READ_OPTION in options:
            raise QueryError(
                f"{command} with {READ_OPTION}= is not answered on LCM; ask on Zenoh (a take: rtc3d-gateway "
                "take fetch, without --lcm)"
            )
        answer = await self._service.answer(source, tuple(command.split("/")), options)
        content = answer.content
        if answer.encoding != JSON or not isinstance(content, bytes):
            raise QueryError(f"the answer to {command} with these options is no JSON; ask on Zenoh")

        def fill(reply: Any) -> None:
            reply.content = content.decode()

        return ReplyContent(len(content), fill)


def _options(request: Any) -> dict[str, str]:
    """Return the options by name. Raises QueryError if one is no NAME=VALUE."""
    options = {}
    for option in request.options:
        name, separator, value = option.partition("=")
        if not separator:
            raise QueryError(f"option {quoted(option)} is not accepted; accepted: NAME=VALUE")
        options[name] = value
    return options
