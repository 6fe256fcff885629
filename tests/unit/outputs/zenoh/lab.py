"""An output on Zenoh, the service that answers its queries, and a peer connected to it."""

import asyncio
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import pytest
import zenoh

from gateway.errors import QueryError
from gateway.outputs.contract import Answer, KeyPath
from gateway.outputs.zenoh.answers import ZenohAnswers
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.failures import current_log_fields
from gateway.runtime.losses import Losses
from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.support.queried_gateway import Reply, query, query_all
from tests.support.statuses import amounts
from tests.support.waiting import wait_until

STATUS, C3D = ("status",), ("c3d",)


class Unmakeable:
    """A payload that cannot be made."""

    num_bytes, is_made = 1, False

    def make(self) -> bytes:
        raise QueryError("no JSON of this frame")


class Service:
    """Answers each key with the number of the call after ``may_answer``, or raises ``error``."""

    def __init__(self) -> None:
        self.sources = {"lab", "hall"}
        self.error: Exception | None = None
        self.num_bytes = 0
        self.may_answer = asyncio.Event()
        self.may_answer.set()
        self.received: list[tuple[str, Sequence[Any], dict[str, str]]] = []
        self.log_fields: dict[str, str] = {}

    def serves(self, source: str) -> bool:
        return source in self.sources

    def keys(self, _source: str) -> list[KeyPath]:
        return [STATUS, C3D, ("parameters", "3d")]

    def commands(self) -> list[str]:
        return ["recording", "take"]

    def accepted_keys(self, _source: str) -> str:
        return "status, c3d"

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        self.received.append((source, path, dict(options)))
        self.log_fields = dict(current_log_fields())
        payload = b"answer %d" % len(self.received)
        await self.may_answer.wait()
        if self.error is not None:
            raise self.error
        return Answer(payload.ljust(self.num_bytes), "text/plain", {"age_s": 1.5})

    async def answer_all(
        self, source: str, paths: Sequence[KeyPath], options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        self.received.append((source, list(paths), dict(options)))
        answers = {path: Answer("/".join(path).encode(), "text/plain") for path in paths}
        return answers if "fail" not in options else answers | {STATUS: Answer(Unmakeable(), "text/plain")}


class Lab:
    """An output, and a peer that connects to it when it is first used."""

    def __init__(self, **settings: Any) -> None:
        self.endpoint = free_endpoint()
        self.output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer", listen=self.endpoint), **settings))
        self.losses = Losses(logging.getLogger("tests"), "lab to zenoh")
        self.samples: list[zenoh.Sample] = []

    @cached_property
    def peer(self) -> zenoh.Session:
        return open_zenoh("client", connect=self.endpoint)

    def open(self) -> None:
        self.output.count_losses("lab", self.losses)
        self.output.start()
        wait_until(lambda: self.output.health().connected)
        wait_until(lambda: not self.output._holder._opener._thread.is_alive())

    def subscribe(self, keys: str) -> zenoh.Subscriber[None]:
        return self.peer.declare_subscriber(keys, self.samples.append)

    def payloads(self, key: str) -> list[bytes]:
        return [each.payload.to_bytes() for each in self.samples if str(each.key_expr) == key]

    @property
    def lost(self) -> dict[str, tuple[int, int]]:
        return amounts(self.losses.report())

    def close(self) -> None:
        self.output.close()
        if "peer" in self.__dict__:
            self.peer.close()


class QueriedLab(Lab):
    """An open output that serves the source "lab"."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.service = Service()
        self.output.serve_queries(self.service)  # type: ignore[arg-type]  # it has the methods that are called
        self.output.announce("lab")

    @property
    def answers(self) -> ZenohAnswers:
        assert self.output._answers is not None
        return self.output._answers

    async def query(self, selector: str) -> Reply:
        return await query(self.peer, selector)

    async def query_all(self, selector: str) -> list[Reply]:
        return await query_all(self.peer, selector)

    async def codes(self, selector: str, times: int) -> Counter[str]:
        """Ask at once; return the number of replies by code, "ok" for those without error."""
        replies = await asyncio.gather(*(self.query_all(selector) for _ in range(times)))
        return Counter(reply.code or "ok" for each in replies for reply in each)

    async def stop(self) -> None:
        self.service.may_answer.set()
        await self.output.stop_queries()
        self.close()


def with_settings(**settings: Any) -> pytest.MarkDecorator:
    """Run a test with a lab that has these settings."""
    return pytest.mark.parametrize("settings", [settings], ids=[""])
