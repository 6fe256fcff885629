"""Commands from LCM: options that are parsed, commands that are carried out once, messages of the history."""

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Final

from gateway.errors import QueryError
from gateway.messages.decode import JSON, LCM_MESSAGES, json_bytes
from gateway.messages.history import unpack_messages
from gateway.messages.topics import MAX_CHANNEL_LENGTH, escape_key_chunk, lcm_channel
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION, QueryService
from gateway.outputs.lcm.replies import ReplyContent
from gateway.runtime.safe_text import quoted

HISTORY: Final = "history"
"""The command that asks for messages again. Its option ``key`` is that of the messages on Zenoh."""

MAX_REMEMBERED: Final = 64
"""How many commands are remembered with their results, for requests that are repeated."""

_REFILL: Final = "_REFILL"


class LcmCommands:
    """Answers commands with ``service``. ``check_nobody_is_refilled`` is that of LcmReplies."""

    def __init__(
        self, prefix: str, service: QueryService, check_nobody_is_refilled: Callable[[], None]
    ) -> None:
        self._prefix = prefix
        self._service = service
        self._check_nobody_is_refilled = check_nobody_is_refilled
        self._remembered: OrderedDict[tuple[Any, ...], asyncio.Task[ReplyContent]] = OrderedDict()

    async def answer(self, source: str, request: Any) -> ReplyContent:
        """Return the answer to a command. Raises QueryError if there is none.

        Requests and replies can be lost on LCM, so their senders repeat them. A command that changes
        something is carried out once nevertheless: equal requests get the result of the first.
        """
        options = {}
        for option in request.options:
            name, separator, value = option.partition("=")
            if not separator:
                raise QueryError(f"option {quoted(option)} is not accepted; accepted: NAME=VALUE")
            options[name] = value
        if CONTROL_OPTION not in options:
            return await self._carry_out(source, request.command, options)
        identity = (source, request.request_id, request.requester, request.command, *request.options)
        task = self._remembered.get(identity)
        if task is None:
            task = asyncio.create_task(self._carry_out(source, request.command, options))
            self._remembered[identity] = task
            task.add_done_callback(lambda done: self._finish(identity, done))
        return await asyncio.shield(task)

    def _finish(self, identity: tuple[Any, ...], task: asyncio.Task[ReplyContent]) -> None:
        """Forget a command that failed, because it may be tried again, and the oldest of too many."""
        if task.cancelled() or task.exception() is not None:
            del self._remembered[identity]
        while len(self._remembered) > MAX_REMEMBERED:
            self._remembered.popitem(last=False)

    def cancel(self) -> None:
        """Stop carrying out commands."""
        for task in [*self._remembered.values()]:
            task.cancel()

    async def _carry_out(self, source: str, command: str, options: dict[str, str]) -> ReplyContent:
        if command == HISTORY and "key" in options:
            return await self._find_messages(source, options)
        if command not in (HISTORY, *self._service.commands()):
            accepted = ", ".join((HISTORY, *self._service.commands()))
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

    async def _find_messages(self, source: str, options: dict[str, str]) -> ReplyContent:
        """Return messages of the history. Those that the peer asks for go to everybody, so one at a time."""
        key = options.pop("key")
        self._check_nobody_is_refilled()
        component, separator, tool = key.partition("/")
        names = (component, tool) if separator else (component,)
        path = (component, escape_key_chunk(tool)) if separator else names
        answer = await self._service.answer(source, path, options)
        if not answer.encoding.startswith(LCM_MESSAGES):
            raise QueryError(f"{HISTORY} with key= needs one of from=, last_s=, since_utime=")
        self._check_nobody_is_refilled()  # the disk may have taken a while
        channel = refill_channel(lcm_channel(self._prefix, source, *names))
        facts = json_bytes({"key": key, "channel": channel, **answer.attachment}).decode()

        def fill(reply: Any) -> None:
            reply.content = facts

        return ReplyContent(answer.num_bytes, fill, (channel, unpack_messages(answer.payload)))


def refill_channel(channel: str) -> str:
    """Return the channel on which messages of ``channel`` are sent again, on the URL of requests."""
    return channel[: MAX_CHANNEL_LENGTH - len(_REFILL)] + _REFILL
