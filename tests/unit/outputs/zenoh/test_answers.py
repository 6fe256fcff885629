"""The limits of queries on Zenoh, and that equal ones share an answer."""

import asyncio

import pytest
import zenoh

from gateway.outputs.contract import ServerParameters
from gateway.outputs.zenoh import answers as answers_module
from gateway.runtime.token_bucket import TokenBucket
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.queried_gateway import to_reply
from tests.support.waiting import wait_until_async
from tests.unit.outputs.zenoh.lab import QueriedLab, with_settings


@pytest.fixture
def lab(queried: QueriedLab) -> QueriedLab:
    return queried


@pytest.fixture
def at_once(lab: QueriedLab, monkeypatch: pytest.MonkeyPatch) -> None:
    """All queries arrive within a moment."""
    monkeypatch.setattr(lab.answers.admission, "_monotonic", lambda: 1000.0)


async def test_equal_queries_share_an_answer_until_there_is_one(lab: QueriedLab) -> None:
    lab.service.may_answer.clear()
    replies: list[bytes] = []

    def receive(reply: zenoh.Reply) -> None:
        replies.append(to_reply(reply).payload)

    for _ in range(50):
        lab.peer.get("mocap/lab/status?a=1;b=2;_time=x", receive, timeout=20)
        lab.peer.get("mocap/lab/status?b=2;a=1", receive, timeout=20)
    await wait_until_async(lambda: lab.answers.admission.num_pending == 100)
    await wait_until_async(lambda: len(lab.service.received) == 1)
    lab.service.may_answer.set()
    await wait_until_async(lambda: len(replies) == 100)
    assert set(replies) == {b"answer 1"}
    assert (await lab.query("mocap/lab/status?a=1;b=2")).payload == b"answer 2"


@with_settings(max_queries_per_key_per_s=1.0)
async def test_each_stop_is_carried_out_whatever_the_rate(lab: QueriedLab, at_once: None) -> None:  # noqa: ARG001
    """A second one may be for what was started while the first one was being carried out."""
    lab.service.may_answer.clear()
    for action in ("start", "stop", "start", "stop"):
        lab.peer.get(f"mocap/lab/recording?set={action}", lambda _: None, timeout=20)
    await wait_until_async(lambda: len(lab.service.received) == 3)
    actions = [options["set"] for _, _, options in lab.service.received]
    assert actions == ["start", "stop", "stop"]  # the second start was beyond the rate


async def test_at_the_end_peers_see_at_once_that_no_answer_follows(lab: QueriedLab) -> None:
    async with asyncio.timeout(60):
        lab.service.may_answer.clear()
        waiting = asyncio.create_task(lab.query_all("mocap/lab/status"))
        await wait_until_async(lambda: lab.service.received)
        await lab.output.stop_queries()
        assert await waiting == []


@pytest.mark.parametrize("selector", ["mocap/lab/status", "mocap/lab/$*a$*b$*c"])
async def test_a_query_after_the_end_ends_without_a_reply(lab: QueriedLab, selector: str) -> None:
    """Its peer would wait for it as long as for a gateway that thinks."""
    await lab.output.stop_queries()
    assert await lab.query_all(selector) == []
    assert lab.output.query_results == {"lab": {"no-reply": 1}}
    assert lab.service.received == []


async def test_more_different_questions_than_are_answered_at_a_time_wait(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers_module, "MAX_QUESTIONS", 2)
    lab.service.may_answer.clear()
    waiting = [asyncio.create_task(lab.query(f"mocap/lab/status?a={n}")) for n in range(5)]
    await wait_until_async(lambda: lab.answers.admission.num_pending == 5)
    await wait_until_async(lambda: len(lab.service.received) == 2)
    lab.service.may_answer.set()
    replies = await asyncio.gather(*waiting)
    assert {reply.payload for reply in replies} == {b"answer %d" % number for number in range(1, 6)}


async def test_a_query_with_wildcards_counts_once_for_each_of_its_keys(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a peer could ask for everything at the price of one query."""
    monkeypatch.setattr(lab.service, "keys", lambda _source: [("a",), ("b",), ("c",)])
    counted: list[int] = []
    monkeypatch.setattr(lab.answers.admission, "count", counted.append)
    assert len(await lab.query_all("mocap/lab/*")) == 3
    assert counted == [2]  # besides the query itself


@pytest.mark.usefixtures("at_once")
@with_settings(max_queries_per_key_per_s=10.0, max_queries_per_s=1000.0)
@pytest.mark.parametrize("selector", ["mocap/lab/status", "mocap/lab/parameters/@adv/**?_anyke"])
async def test_queries_beyond_the_rate_get_an_error_and_are_counted(
    lab: QueriedLab, caplog: pytest.LogCaptureFixture, selector: str
) -> None:
    lab.output.publish_parameters("lab", ServerParameters(b"<xml/>", 1, 1))
    codes = await lab.codes(selector, 60)
    assert codes == {"ok": 10, "rate": 50}
    assert lab.output.query_results == {"lab": codes}
    assert lab.lost == {"query beyond the rate": (50, 0)}
    [warning] = [record for record in caplog.records if record.levelname == "WARNING"]
    assert names(warning.message, "lab", 10, "zenoh.max_queries_per_key_per_s")


@pytest.mark.usefixtures("at_once")
@with_settings(max_queries_per_key_per_s=10.0)
async def test_a_flood_of_queries_is_not_a_flood_of_errors(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab.answers.admission, "_refusals", TokenBucket(2.0, monotonic=Clock()))
    assert await lab.codes("mocap/lab/status", 30) == {"ok": 10, "rate": 2}


@with_settings(max_reply_bytes_per_s=1024)
async def test_replies_beyond_the_bytes_of_a_second_are_errors(lab: QueriedLab) -> None:
    lab.service.num_bytes = 4000
    codes = await lab.codes("mocap/lab/status", 5)
    assert codes["ok"] >= 1
    assert codes["rate"] >= 1


@pytest.mark.parametrize(
    ("selector", "num_bytes", "values"),
    [
        ("mocap/lab/" + 600 * "x", 0, [610, 512]),
        ("mocap/lab/status?" + 2000 * "x", 0, ["options", 1024]),
        ("mocap/lab/$*a$*b$*c", 0, [2, "$*"]),
        ("mocap/lab/status", 5000, [5000, 4096]),
    ],
)
async def test_a_query_that_is_too_long_is_an_error(
    lab: QueriedLab, selector: str, num_bytes: int, values: list[object]
) -> None:
    payload = bytes(num_bytes) or None
    [reply] = await asyncio.to_thread(lambda: list(lab.peer.get(selector, timeout=20, payload=payload)))
    assert to_reply(reply).code == "bad-request"
    assert names(to_reply(reply).error, *values)
    assert lab.service.received == []
