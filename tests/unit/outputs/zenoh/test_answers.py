"""The limits of queries on Zenoh, and that equal ones share an answer."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest
import zenoh

from gateway.losses import Losses
from gateway.outputs.contract import Answer, KeyPath, ServerParameters
from gateway.outputs.zenoh import answers as answers_module
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.token_bucket import TokenBucket
from tests.losses import amounts
from tests.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.queried_gateway import query, query_all, to_reply
from tests.settable_clock import Clock
from tests.waiting import wait_until_async


class Service:
    """Answers with the number of the call, after ``may_answer``."""

    def __init__(self) -> None:
        self.num_calls = 0
        self.num_bytes = 1
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    def serves(self, _source: str) -> bool:
        return True

    def keys(self, _source: str) -> list[KeyPath]:
        return [("status",)]

    def commands(self) -> list[str]:
        return ["recording", "take"]

    def accepted_keys(self, _source: str) -> str:
        return "status"

    async def answer(self, _source: str, _path: KeyPath, _options: Mapping[str, str]) -> Answer:
        self.num_calls += 1
        payload = b"%d" % self.num_calls
        await self.may_answer.wait()
        return Answer(payload.ljust(self.num_bytes), "text/plain")


class Lab:
    def __init__(self, output: ZenohOutput, service: Service, peer: zenoh.Session) -> None:
        self.output, self.service, self.peer = output, service, peer
        self.losses = Losses(answers_module.logger, "lab to zenoh")
        output.count_losses("lab", self.losses)

    async def codes(self, selector: str, times: int) -> Counter[str]:
        """Ask at once; return the number of replies by code, "ok" for those without error."""
        replies = await asyncio.gather(*(query_all(self.peer, selector) for _ in range(times)))
        return Counter(reply.code or "ok" for each in replies for reply in each)


@asynccontextmanager
async def open_lab(**settings: Any) -> AsyncIterator[Lab]:
    endpoint, service = free_endpoint(), Service()
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer", listen=endpoint), **settings))
    output.serve_queries(service)  # type: ignore[arg-type]  # it has the methods that are called
    output.announce("lab")
    output.start()
    await wait_until_async(lambda: output.health().connected)
    await asyncio.to_thread(output.wait_until_open, 30)  # it declares the queryables last
    peer = open_zenoh("client", connect=endpoint)
    try:
        yield Lab(output, service, peer)
    finally:
        await output.stop_queries()
        output.close()
        peer.close()


async def test_equal_queries_share_an_answer_until_there_is_one() -> None:
    async with open_lab() as lab:
        lab.service.may_answer.clear()
        replies: list[bytes] = []

        def receive(reply: zenoh.Reply) -> None:
            replies.append(to_reply(reply).payload)

        for _ in range(50):
            lab.peer.get("mocap/lab/status?a=1;b=2;_time=x", receive, timeout=20)
            lab.peer.get("mocap/lab/status?b=2;a=1", receive, timeout=20)
        queries = lab.output._queries
        assert queries is not None
        await wait_until_async(lambda: queries._admission.num_pending == 100)
        await wait_until_async(lambda: lab.service.num_calls == 1)
        lab.service.may_answer.set()
        await wait_until_async(lambda: len(replies) == 100)
        assert set(replies) == {b"1"}
        assert (await query(lab.peer, "mocap/lab/status?a=1;b=2")).payload == b"2"


async def test_at_the_end_peers_see_at_once_that_no_answer_follows() -> None:
    async with open_lab() as lab, asyncio.timeout(60):
        lab.service.may_answer.clear()
        waiting = asyncio.create_task(query_all(lab.peer, "mocap/lab/status"))
        await wait_until_async(lambda: lab.service.num_calls == 1)
        await lab.output.stop_queries()
        assert await waiting == []


async def test_more_different_questions_than_are_answered_at_a_time_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers_module, "MAX_QUESTIONS", 2)
    async with open_lab() as lab:
        lab.service.may_answer.clear()
        waiting = [asyncio.create_task(query(lab.peer, f"mocap/lab/status?a={n}")) for n in range(5)]
        queries = lab.output._queries
        assert queries is not None
        await wait_until_async(lambda: queries._admission.num_pending == 5)
        await wait_until_async(lambda: lab.service.num_calls == 2)
        lab.service.may_answer.set()
        replies = await asyncio.gather(*waiting)
        assert {reply.payload for reply in replies} == {b"1", b"2", b"3", b"4", b"5"}


async def test_a_query_with_wildcards_counts_once_for_each_of_its_keys(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise a peer could ask for everything at the price of one query."""
    async with open_lab() as lab:

        async def answer_all(_source: str, paths: list[KeyPath], _options: object) -> dict[KeyPath, Answer]:
            return {path: Answer(b"", "text/plain") for path in paths}

        monkeypatch.setattr(lab.service, "keys", lambda _source: [("a",), ("b",), ("c",)])
        monkeypatch.setattr(lab.service, "answer_all", answer_all, raising=False)
        queries = lab.output._queries
        assert queries is not None
        counted: list[int] = []
        monkeypatch.setattr(queries._admission, "count", counted.append)
        assert len(await query_all(lab.peer, "mocap/lab/*")) == 3
        assert counted == [2]  # besides the query itself


@pytest.mark.parametrize("selector", ["mocap/lab/status", "mocap/lab/parameters/@adv/**?_anyke"])
async def test_queries_beyond_the_rate_get_an_error_and_are_counted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, selector: str
) -> None:
    async with open_lab(max_queries_per_key_per_s=10.0, max_queries_per_s=1000.0) as lab:
        lab.output.publish_parameters("lab", ServerParameters(b"<xml/>", 1, 1))
        queries = lab.output._queries
        assert queries is not None
        monkeypatch.setattr(queries._admission, "_monotonic", lambda: 1000.0)  # all within a moment
        codes = await lab.codes(selector, 60)
        assert codes["ok"] == 10
        assert codes == {"ok": codes["ok"], "rate": 60 - codes["ok"]}
        assert lab.output.query_results == {"lab": codes}
        assert amounts(lab.losses.report()) == {"query beyond the rate": (codes["rate"], 0)}
        [warning] = [record.message for record in caplog.records if "refused" in record.message]
        assert "10 queries a second like this one" in warning
        assert "raise zenoh.max_queries_per_key_per_s" in warning


async def test_a_flood_of_queries_is_not_a_flood_of_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_lab(max_queries_per_key_per_s=10.0) as lab:
        queries = lab.output._queries
        assert queries is not None
        monkeypatch.setattr(queries._admission, "_monotonic", lambda: 1000.0)  # all within a moment
        monkeypatch.setattr(queries._admission, "_refusals", TokenBucket(2.0, monotonic=Clock()))
        assert await lab.codes("mocap/lab/status", 30) == {"ok": 10, "rate": 2}


async def test_replies_beyond_the_bytes_of_a_second_are_errors() -> None:
    async with open_lab(max_reply_bytes_per_s=1024) as lab:
        lab.service.num_bytes = 4000
        codes = await lab.codes("mocap/lab/status", 5)
        assert codes["ok"] >= 1
        assert codes["rate"] >= 1


@pytest.mark.parametrize(
    ("selector", "num_bytes", "text"),
    [
        ("mocap/lab/" + 600 * "x", 0, "a key has 610 characters; accepted: 512"),
        ("mocap/lab/status?" + 2000 * "x", 0, "the options have more than 1024 characters"),
        ("mocap/lab/$*a$*b$*c", 0, "a selector has more than 2 times $*; use * or **"),
        ("mocap/lab/status", 5000, "a query has 5000 bytes of payload and attachment; accepted: 4096"),
    ],
)
async def test_a_query_that_is_too_long_is_an_error(selector: str, num_bytes: int, text: str) -> None:
    async with open_lab() as lab:
        payload = bytes(num_bytes) or None
        [reply] = await asyncio.to_thread(lambda: list(lab.peer.get(selector, timeout=20, payload=payload)))
        assert (to_reply(reply).error, to_reply(reply).code) == (text, "bad-request")
        assert lab.service.num_calls == 0


@pytest.mark.parametrize("selector", ["mocap/lab/status", "mocap/lab/$*a$*b$*c"])
async def test_a_query_after_the_end_ends_without_a_reply(selector: str) -> None:
    """Its peer would wait for it as long as for a gateway that thinks."""
    async with open_lab() as lab:
        await lab.output.stop_queries()
        assert await query_all(lab.peer, selector) == []
        assert lab.output.query_results == {"lab": {"no-reply": 1}}
        assert lab.service.num_calls == 0
