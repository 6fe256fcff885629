"""Parameters on LCM in memory: what subscribers receive."""

import asyncio
import threading
from types import SimpleNamespace

import lcm
import pytest

from gateway.outputs.contract import ServerParameters
from gateway.outputs.lcm import queries as parameters_module
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.queries import REPEAT_S
from gateway.outputs.lcm.settings import LcmSettings
from tests.settable_clock import Clock
from tests.unit.outputs.lcm.peer import XML, Lab, request


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clocks of the queries; ``now_s`` is the time since the program started."""
    clock = Clock(100.0)
    monkeypatch.setattr(parameters_module, "time", SimpleNamespace(monotonic=clock))
    monkeypatch.setattr(parameters_module, "now_utime", lambda: round(1e6 * clock.now_s))
    return clock


async def test_parameters_are_published_now_and_every_few_seconds(lab: Lab, clock: Clock) -> None:
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


async def test_new_parameters_replace_the_old_ones_and_continue_the_sequence(lab: Lab, clock: Clock) -> None:
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


async def test_parameters_of_a_withdrawn_source_are_not_published_again(lab: Lab, clock: Clock) -> None:
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.output.withdraw("lab")
    lab.output.withdraw("lab")
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert len(lab.parameters) == 1


async def test_an_output_without_queries_has_no_results() -> None:
    output = LcmOutput(LcmSettings(url="memq://"), lcm.LCM("memq://"))
    output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    output.maintain()
    assert output.query_results is None
    await output.stop_queries()


async def test_long_parameters_are_sent_by_a_thread(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """Short ones must not overtake them: late subscribers would keep the old names."""
    monkeypatch.setattr(parameters_module, "LONG_REPLY_BYTES", 10)
    may_send = threading.Event()
    lab.queries._long_sender.submit(may_send.wait)
    sent = lab.output.publish_parameters("lab", ServerParameters(b"<long enough/>", 3, 4))
    short = lab.output.publish_parameters("lab", ServerParameters(b"<a/>", 3, 5))
    may_send.set()
    assert sent is not None
    assert short is not None
    await asyncio.gather(sent, short)
    again = lab.output.publish_parameters("lab", ServerParameters(b"<longer than that/>", 3, 6))
    assert again is not None
    await again
    lab.deliver()
    assert [message.xml for message in lab.parameters] == ["<a/>", "<a/>", "<longer than that/>"]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    lab.send(request(1))
    [reply] = await lab.receive()
    assert reply.xml == XML.decode()


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
    lab.send(request())
    [reply] = await lab.receive()
    assert reply.xml == text


async def test_parameters_published_before_lcm_opens_follow_later(clock: Clock) -> None:
    lab = Lab()
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.open()
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert [message.xml for message in lab.parameters] == [XML.decode()]
    await lab.output.stop_queries()
    lab.output.close()
