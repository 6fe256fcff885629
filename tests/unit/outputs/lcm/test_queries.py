"""Requests and parameters on LCM in memory: what peers receive, and what the output counts."""

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from types import SimpleNamespace
from typing import Any

import lcm
import pytest
import rtc3d

from gateway.errors import QueryError
from gateway.log import current_log_fields
from gateway.losses import Losses
from gateway.messages.decode import decode
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lcm import queries as queries_module
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.queries import MAX_REQUEST_BYTES, MAX_REQUESTER_BYTES, REPEAT_S
from gateway.outputs.lcm.sender import LcmSender
from gateway.outputs.lcm.settings import LcmSettings
from tests.losses import amounts
from tests.waiting import wait_until_async

XML = b"<RT_Parameters/>"


class Service:
    """Answers requests with ``parameters``, or raises it if it is an exception."""

    def __init__(self) -> None:
        self.sources = {"lab", "hall"}
        self.reply: ServerParameters | Exception = ServerParameters(XML, 3, 4, 2.5)
        self.received: list[tuple[str, list[str], bool]] = []
        self.log_fields: list[dict[str, str]] = []
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    def serves(self, source: str) -> bool:
        return source in self.sources

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        self.received.append((source, list(sections), fresh))
        self.log_fields.append(dict(current_log_fields()))
        await self.may_answer.wait()
        if isinstance(self.reply, Exception):
            raise self.reply
        return self.reply


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
        self.lcm.subscribe("MOCAP_.*_PARAMETERS_REPLY", lambda _, data: self.replies.append(decode(data)))
        self.lcm.subscribe("MOCAP_LAB_PARAMETERS", lambda _, data: self.parameters.append(decode(data)))

    def open(self) -> None:
        self.output.announce("lab")
        self.output.start()

    def lost(self, source: str) -> dict[str, tuple[int, int]]:
        return amounts(self._losses[source].report())

    def deliver(self) -> None:
        """Pass on the messages that were published."""
        while self.lcm.handle_timeout(0):
            pass

    def send(self, data: bytes, source: str = "LAB") -> None:
        self.lcm.publish(f"MOCAP_{source}_PARAMETERS_REQUEST", data)
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


@pytest.fixture
async def lab() -> AsyncIterator[Lab]:
    lab = Lab()
    yield lab
    lab.service.may_answer.set()
    await lab.output.stop_queries()
    lab.output.close()


# Requests ------------------------------------------------------------------------------------


async def test_a_reply_has_the_answer_of_the_service(lab: Lab) -> None:
    lab.open()
    lab.send(request(7, "3d", "force", fresh=True))
    [reply] = await lab.receive()
    assert (reply.request_id, reply.requester) == (7, "test")
    assert (reply.xml, reply.age_s, reply.error, reply.error_code) == (XML.decode(), 2.5, "", "")
    assert reply.parameters_version == 4
    assert lab.service.received == [("lab", ["3d", "force"], True)]
    assert lab.service.log_fields == [{"source": "lab"}]
    assert lab.output.query_results == {"ok": 1}


async def test_sources_are_served_whenever_they_are_announced(lab: Lab) -> None:
    lab.open()
    lab.output.announce("hall")
    lab.output.announce("hall")
    lab.send(request(1), "HALL")
    await lab.receive()
    lab.send(request(2), "LAB")
    await lab.receive(2)
    assert [reply.request_id for reply in lab.replies] == [1, 2]
    assert lab.service.received == [("hall", [], False), ("lab", [], False)]


async def test_an_error_of_the_service_is_the_reply(lab: Lab) -> None:
    lab.service.reply = QueryError("the server refuses", code="refused")
    lab.open()
    lab.send(request(7))
    [reply] = await lab.receive()
    assert (reply.request_id, reply.requester) == (7, "test")
    assert (reply.xml, reply.error, reply.error_code) == ("", "the server refuses", "refused")
    assert lab.output.query_results == {"refused": 1}


async def test_a_defect_is_logged_and_reported_in_the_reply(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    lab.service.reply = ZeroDivisionError("of the test")
    lab.open()
    lab.send(request(7))
    [reply] = await lab.receive()
    assert (reply.error, reply.error_code) == (
        "a defect in the gateway: ZeroDivisionError('of the test')",
        "defect",
    )
    assert lab.output.query_results == {"defect": 1}
    [record] = caplog.records
    assert record.message == "lab: LCM request 7 of 'test'"
    assert record.exc_info is not None


async def test_a_source_that_is_no_longer_served_gets_no_reply(
    lab: Lab,
) -> None:
    lab.open()
    lab.service.sources.clear()
    lab.send(request(1))
    await asyncio.sleep(0)  # the event loop rejects the request
    lab.service.sources.add("lab")
    lab.send(request(2))
    assert [reply.request_id for reply in await lab.receive()] == [2]


async def test_requests_beyond_the_limit_are_dropped_and_counted_by_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(queries_module, "MAX_PENDING", 2)
    lab = Lab()
    lab.open()
    lab.output.announce("hall")
    lab.service.may_answer.clear()
    lab.service.sources.discard("hall")
    for _ in range(3):
        lab.send(request(0), "HALL")  # refused requests must not keep their places
        await asyncio.sleep(0)
    assert lab.lost("hall") == {}
    for number in range(4):
        lab.send(request(number))
        await asyncio.sleep(0)
    assert lab.lost("lab") == {"request beyond the queue": (2, 0)}
    lab.service.may_answer.set()
    assert [reply.request_id for reply in await lab.receive(2)] == [0, 1]
    lab.send(request(5))
    await lab.receive(3)
    assert lab.lost("lab") == {"request beyond the queue": (2, 0)}
    await lab.output.stop_queries()


async def test_requests_beyond_the_rate_get_an_error_and_are_counted() -> None:
    lab = Lab(max_queries_per_source_per_s=1.0)
    lab.open()
    for number in range(8):
        lab.send(request(number))
    replies = await lab.receive(8)
    refused = [reply for reply in replies if reply.error_code == "rate"]
    assert refused
    assert len(refused) < 8
    assert {reply.requester for reply in refused} == {"test"}
    assert "raise lcm.max_queries_per_source_per_s" in refused[0].error
    assert lab.lost("lab") == {"request beyond the rate": (len(refused), 0)}
    assert lab.output.query_results == {"ok": 8 - len(refused), "rate": len(refused)}
    await lab.output.stop_queries()


async def test_replies_beyond_the_bytes_of_a_second_are_errors() -> None:
    lab = Lab(max_reply_bytes_per_s=1024)
    lab.service.reply = ServerParameters(b"x" * 4000, 3, 4)
    lab.open()
    lab.send(request(1))
    lab.send(request(2))
    assert [reply.error_code for reply in await lab.receive(2)] == ["", "rate"]
    await lab.output.stop_queries()


async def test_long_parameters_are_sent_by_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queries_module, "LONG_XML_BYTES", 10)
    lab = Lab()
    lab.open()
    sent = lab.output.publish_parameters("lab", ServerParameters(b"<long enough/>", 3, 4))
    assert sent is not None
    await sent
    again = lab.output.publish_parameters("lab", ServerParameters(b"<longer than that/>", 3, 5))
    assert again is not None
    await again
    lab.deliver()
    assert [message.xml for message in lab.parameters] == ["<long enough/>", "<longer than that/>"]
    assert [message.sequence for message in lab.parameters] == [0, 1]
    lab.send(request(1))
    [reply] = await lab.receive()
    assert reply.xml == XML.decode()
    await lab.output.stop_queries()


async def test_malformed_requests_are_counted_by_source(lab: Lab) -> None:
    lab.open()
    lab.output.announce("hall")
    good = request(1)
    for data in (b"", good[:-1], bytes(8) + good[8:]):
        lab.send(data)
    assert lab.lost("lab") == {"malformed request": (3, 0)}
    assert lab.lost("hall") == {}


async def test_the_limits_of_a_request_are_exact(lab: Lab) -> None:
    lab.open()
    lab.send(request(1, requester="ä" * (MAX_REQUESTER_BYTES // 2)))
    lab.send(request(2) + bytes(MAX_REQUEST_BYTES - len(request(2))))
    await lab.receive(2)
    assert lab.lost("lab") == {}
    lab.send(request(3, requester="ä" * (MAX_REQUESTER_BYTES // 2) + "x"))
    lab.send(request(4) + bytes(MAX_REQUEST_BYTES + 1 - len(request(4))))
    assert lab.lost("lab") == {"malformed request": (2, 0)}


@pytest.mark.parametrize(
    ("xml", "text"),
    [
        ("<µm/>".encode(), "<µm/>"),
        ("<µm/>".encode("latin-1"), "<µm/>"),
        (b"<a/>\0\0", "<a/>"),
        (b"\0<a/>\0b", "\0<a/>\0b"),
    ],
    ids=["UTF-8", "Latin-1", "NULs at the end", "other NULs"],
)
async def test_xml_is_sent_as_text_without_the_nuls_at_its_end(lab: Lab, xml: bytes, text: str) -> None:
    lab.service.reply = ServerParameters(xml, 1, 4)
    lab.open()
    lab.send(request())
    [reply] = await lab.receive()
    assert reply.xml == text


async def test_after_the_end_of_queries_no_request_is_answered() -> None:
    lab = Lab()
    lab.open()
    lab.service.may_answer.clear()
    lab.send(request(1))
    await wait_until_async(lambda: lab.service.received)
    await lab.output.stop_queries()
    lab.service.may_answer.set()
    lab.send(request(2))
    await asyncio.sleep(0)
    lab.deliver()
    assert lab.replies == []
    assert len(lab.service.received) == 1


async def test_a_request_after_the_end_of_the_event_loop_is_ignored(lab: Lab) -> None:
    loop = asyncio.new_event_loop()
    loop.close()
    sender = LcmSender("memq://", lab.lcm, lambda: None)
    queries = queries_module.LcmQueries(
        LcmSettings(url="memq://"),
        lab.service,  # type: ignore[arg-type]  # it has the methods that LCM calls
        loop,
        sender,
        lab.lcm,
    )
    queries.add("lab")
    lab.send(request())
    await queries.close()


# Parameters ----------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The clocks of the queries; ``now_s`` is the time since the program started."""
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(queries_module, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(queries_module, "now_utime", lambda: round(1e6 * clock.now_s))
    return clock


async def test_parameters_are_published_now_and_every_few_seconds(lab: Lab, clock: SimpleNamespace) -> None:
    lab.open()
    lab.output.publish_parameters("lab", ServerParameters(XML + b"\0", 3, 4))
    for step_s in (0.0, REPEAT_S - 0.5, 0.5, 0.5, REPEAT_S):
        clock.now_s += step_s
        lab.output.maintain()
    lab.deliver()
    sent_s = [100.0, 100.0 + REPEAT_S, 100.5 + 2 * REPEAT_S]
    assert [message.utime for message in lab.parameters] == [round(1e6 * each) for each in sent_s]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    assert {message.capture_utime for message in lab.parameters} == {100_000_000}
    assert {(message.session, message.parameters_version) for message in lab.parameters} == {(3, 4)}
    assert {message.xml for message in lab.parameters} == {XML.decode()}


async def test_new_parameters_replace_the_old_ones_and_continue_the_sequence(
    lab: Lab, clock: SimpleNamespace
) -> None:
    lab.open()
    lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
    clock.now_s += 1.0
    lab.output.publish_parameters("lab", ServerParameters(b"<new/>", 2, 4))
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert [message.xml for message in lab.parameters] == ["<old/>", "<new/>", "<new/>"]
    assert [message.session for message in lab.parameters] == [1, 2, 2]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    assert [message.capture_utime for message in lab.parameters] == [100_000_000, 101_000_000, 101_000_000]


async def test_parameters_of_a_withdrawn_source_are_not_published_again(
    lab: Lab, clock: SimpleNamespace
) -> None:
    lab.open()
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.output.withdraw("lab")
    lab.output.withdraw("lab")
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert len(lab.parameters) == 1


async def test_parameters_published_before_lcm_opens_follow_later(
    lab: Lab, clock: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.outputs.lcm.queries")
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.open()
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert [message.xml for message in lab.parameters] == [XML.decode()]


async def test_an_output_without_queries_has_no_results() -> None:
    output = LcmOutput(LcmSettings(url="memq://"), lcm.LCM("memq://"))
    output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    output.maintain()
    assert output.query_results is None
    await output.stop_queries()
