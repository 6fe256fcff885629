"""An output on LCM in memory, its query service, and a peer."""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import lcm
import pytest
import rtc3d

from gateway.messages.decode import JSON, decode, json_bytes
from gateway.outputs.contract import Answer, KeyPath, ServerParameters
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.requests import LcmRequests
from gateway.outputs.lcm.settings import LcmSettings
from gateway.runtime.failures import current_log_fields
from gateway.runtime.losses import Losses
from tests.support.statuses import amounts
from tests.support.waiting import wait_until_async

XML = b"<RT_Parameters/>"
JSON_ANSWER = Answer(json_bytes({"name": "walk-1"}), JSON)


class Service:
    """Answers requests with ``parameters``, or raises it if it is an exception."""

    def __init__(self) -> None:
        self.sources = {"lab", "hall"}
        self.reply: ServerParameters | Exception = ServerParameters(XML, 3, 4, 2.5)
        self.received: list[tuple[str, list[str], bool]] = []
        self.log_fields: list[dict[str, str]] = []
        self.may_answer = asyncio.Event()
        self.may_answer.set()
        self.answers: dict[str, Answer | Exception] = {"take": JSON_ANSWER}
        """The answer to each command."""
        self.commands_received: list[tuple[str, KeyPath, dict[str, str]]] = []

    def serves(self, source: str) -> bool:
        return source in self.sources

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        self.received.append((source, list(sections), fresh))
        self.log_fields.append(dict(current_log_fields()))
        await self.may_answer.wait()
        if isinstance(self.reply, Exception):
            raise self.reply
        return self.reply

    def commands(self) -> list[str]:
        return ["recording", "take"]

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        self.commands_received.append((source, path, dict(options)))
        await self.may_answer.wait()
        answer = self.answers["/".join(path)]
        if isinstance(answer, Exception):
            raise answer
        return answer


class Lab:
    """An output on LCM in memory, and a peer on the same LCM object."""

    def __init__(self, **settings: Any) -> None:
        self.service = Service()
        self.lcm = lcm.LCM("memq://")
        self.output = LcmOutput(LcmSettings(url="memq://", **settings), self.lcm)
        self.output.serve_queries(self.service)  # type: ignore[arg-type]  # it has the methods that LCM calls
        self._losses = {name: Losses(logging.getLogger("tests"), name) for name in ("lab", "hall")}
        for name, losses in self._losses.items():
            self.output.count_losses(name, losses)
        self.replies: list[Any] = []
        self.parameters: list[Any] = []
        self.lcm.subscribe("MOCAP_.*_REPLY", lambda _, data: self.replies.append(decode(data)))
        self.lcm.subscribe("MOCAP_LAB_PARAMETERS", lambda _, data: self.parameters.append(decode(data)))

    def open(self) -> None:
        self.output.announce("lab")
        self.output.start()

    @property
    def requests(self) -> LcmRequests:
        assert self.output._requests is not None
        return self.output._requests

    def lost(self, source: str) -> dict[str, tuple[int, int]]:
        return amounts(self._losses[source].report())

    def deliver(self) -> None:
        """Pass on the messages that were published."""
        while self.lcm.handle_timeout(0):
            pass

    def send(self, data: bytes, source: str = "LAB", kind: str = "PARAMETERS") -> None:
        self.lcm.publish(f"MOCAP_{source}_{kind}_REQUEST", data)
        self.deliver()

    async def receive(self, number: int = 1) -> list[Any]:
        """Wait for this number of replies, and return them."""

        def has_received() -> bool:
            self.deliver()
            return len(self.replies) >= number

        await wait_until_async(has_received)
        return self.replies


def request(number: int = 1, *sections: str, fresh: bool = False, requester: str = "test") -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = number, requester, fresh
    message.sections, message.num_sections = list(sections), len(sections)
    encoded: bytes = message.encode()
    return encoded


def command_request(number: int = 1, command: str = "take", *options: str, requester: str = "test") -> bytes:
    message = rtc3d.command_request_t()
    message.request_id, message.requester, message.command = number, requester, command
    message.options, message.num_options = list(options), len(options)
    encoded: bytes = message.encode()
    return encoded


def with_settings(**settings: Any) -> pytest.MarkDecorator:
    """Run a test with a ``lab`` that has these settings."""
    return pytest.mark.parametrize("lab", [settings], indirect=True, ids=[""])
