"""Queries, parameters and files of the Zenoh output, with a scripted service."""

import asyncio
import json
import logging
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs import other_gateways
from gateway.outputs.contract import ServerFile, ServerParameters
from gateway.outputs.zenoh import answers as answers_module
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.losses import Losses
from tests.support.errors import names
from tests.support.networks import open_zenoh, zenoh_keys
from tests.support.statuses import amounts
from tests.support.waiting import wait_until_async
from tests.unit.outputs.zenoh.lab import STATUS, QueriedLab

XML = b"<RT_Parameters/>"


@pytest.fixture
def lab(queried: QueriedLab) -> QueriedLab:
    return queried


# Other gateways ------------------------------------------------------------------------------


async def test_gateways_with_a_source_of_one_name_notice_each_other(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Subscribers get the messages of both, in any order. The tokens alive of both are the same."""
    monkeypatch.setattr(other_gateways, "HOLD_S", 0.0)
    assert lab.output.warnings() == []
    other = ZenohOutput(ZenohSettings(config=zenoh_keys("client", connect=lab.endpoint)))
    other.serve_queries(lab.service)  # type: ignore[arg-type]  # it has the methods that are called
    for name in ("hall", "lab"):
        other.announce(name)
    try:
        other.start()
        await wait_until_async(lambda: len(lab.output.warnings()) == len(other.warnings()) == 1)
        other.withdraw("lab")
        await wait_until_async(lambda: not lab.output.warnings())
        assert other.warnings() == []
        other.announce("lab")
        await wait_until_async(lambda: len(lab.output.warnings()) == len(other.warnings()) == 1)
    finally:
        await other.stop_queries()
        await asyncio.to_thread(other.close)
    await wait_until_async(lambda: not lab.output.warnings())


# Queries -------------------------------------------------------------------------------------


async def test_the_service_receives_source_path_and_options(lab: QueriedLab) -> None:
    reply = await lab.query("mocap/lab/parameters/3d?format=json;fresh;_time=now;a=b=c")
    assert reply == ("mocap/lab/parameters/3d", b"answer 1", "text/plain", {"age_s": 1.5}, "", "")
    options = {"format": "json", "fresh": "", "a": "b=c"}
    assert lab.service.received == [("lab", ("parameters", "3d"), options)]
    assert lab.service.log_fields == {"source": "lab"}
    await wait_until_async(lambda: lab.output.query_results == {"lab": {"ok": 1}})


async def test_a_selector_with_wildcards_gets_one_reply_for_each_key(lab: QueriedLab) -> None:
    replies = await lab.query_all("mocap/lab/**?format=json")
    assert sorted((reply.key, reply.payload, reply.attachment) for reply in replies) == [
        ("mocap/lab/parameters/3d", b"parameters/3d", {}),
        ("mocap/lab/status", b"status", {}),
    ]
    assert lab.service.received == [("lab", [STATUS, ("parameters", "3d")], {"format": "json"})]
    replies = await lab.query_all("mocap/lab/**?fail=yes")
    assert [(reply.key, reply.code) for reply in replies] == [("mocap/lab/parameters/3d", "")]
    replies = await lab.query_all("mocap/lab/parameters/*")
    assert [reply.key for reply in replies] == ["mocap/lab/parameters/3d"]
    replies = await lab.query_all("mocap/*/c3d")
    assert [(reply.key, reply.payload) for reply in replies] == [("mocap/lab/c3d", b"c3d")]


@pytest.mark.parametrize(
    ("selector", "values"),
    [
        ("mocap/lab/x/*", ["'lab'", "mocap/lab/x/*", "mocap/lab/: status, c3d"]),
        ("mocap/*/recording", ["mocap/lab/recording"]),
    ],
)
async def test_a_selector_that_matches_nothing_is_an_error_with_the_accepted_keys(
    lab: QueriedLab, selector: str, values: list[str]
) -> None:
    reply = await lab.query(selector)
    assert reply.code == "bad-request"
    assert names(reply.error, *values)
    assert lab.service.received == []
    await wait_until_async(lambda: lab.output.query_results == {"lab": {"bad-request": 1}})


async def test_errors_are_replies_with_their_code_and_are_counted(
    lab: QueriedLab, caplog: pytest.LogCaptureFixture
) -> None:
    lab.service.error = QueryError("the server refuses", code="refused")
    for _ in range(2):
        reply = await lab.query("mocap/lab/status")
        assert (reply.error, reply.encoding) == ("the server refuses", "text/plain;refused")
    lab.service.error = ZeroDivisionError("of the test")
    reply = await lab.query("mocap/lab/status?a=1")
    assert names(reply.error, "ZeroDivisionError('of the test')")
    assert reply.encoding == "text/plain;defect"
    [record] = caplog.records
    assert record.message == "lab: query mocap/lab/status?a=1"
    assert record.exc_info is not None
    await wait_until_async(lambda: lab.output.query_results == {"lab": {"refused": 2, "defect": 1}})


async def test_sources_are_served_between_announcement_and_withdrawal(lab: QueriedLab) -> None:
    assert await lab.query_all("mocap/hall/status") == []
    lab.output.announce("hall")
    lab.output.announce("hall")
    reply = await lab.query("mocap/hall/status")
    assert reply.key == "mocap/hall/status"
    lab.output.withdraw("hall")
    lab.output.withdraw("hall")
    assert await lab.query_all("mocap/hall/status") == []
    assert (await lab.query("mocap/lab/status")).key == "mocap/lab/status"


async def test_a_source_that_the_gateway_no_longer_has_gets_no_reply(lab: QueriedLab) -> None:
    lab.service.sources.discard("lab")
    assert await lab.query_all("mocap/lab/status") == []
    assert lab.service.received == []


async def test_long_answers_arrive_unchanged_and_are_sent_by_a_thread_of_their_own(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers_module, "LONG_ANSWER_BYTES", 8)
    used: list[str] = []
    for name, sender in (
        ("short", lab.output._sender),
        ("long", lab.answers._long_sender),
    ):
        offer = sender.offer

        def record(call: Any, num_bytes: int = 0, name: str = name, offer: Any = offer) -> Any:
            used.append(name)
            return offer(call, num_bytes)

        monkeypatch.setattr(sender, "offer", record)
    assert (await lab.query("mocap/lab/status")).payload == b"answer 1"
    lab.service.num_bytes = 9
    assert (await lab.query("mocap/lab/status")).payload == b"answer 2 "
    assert used == ["short", "long"]


# Parameters and files ------------------------------------------------------------------------


async def test_parameters_are_published_with_their_encoding_and_a_low_priority(lab: QueriedLab) -> None:
    lab.subscribe("mocap/lab/parameters")
    frame = CoordinateFrame("lab", 0.01, translation_m=(0, 0, 2))
    lab.output.publish_parameters("lab", ServerParameters(XML, 1, 4, frame=frame))
    await wait_until_async(lambda: lab.samples)
    sample = lab.samples[0]
    assert (sample.payload.to_bytes(), str(sample.encoding)) == (XML, "application/xml")
    assert sample.attachment is not None
    assert json.loads(sample.attachment.to_bytes()) == {
        "session": 1,
        "parameters_version": 4,
        "frame": {
            "frame_id": "lab",
            "metres_per_unit": 0.01,
            "rotation_xyzw": [0, 0, 0, 1],
            "translation_m": [0, 0, 2],
        },
    }
    assert sample.congestion_control == zenoh.CongestionControl.BLOCK
    assert sample.priority == zenoh.Priority.DATA_LOW


async def test_files_are_announced_as_json_on_the_key_that_returns_them(lab: QueriedLab) -> None:
    lab.subscribe("mocap/lab/*")
    await lab.query("mocap/lab/status")
    file = ServerFile(Path("/spool/Käfig.c3d"), 7)

    def announced() -> list[bytes]:
        lab.output.announce_file("lab", file)
        return lab.payloads("mocap/lab/c3d")

    await wait_until_async(announced)
    [sample, *_] = lab.samples
    assert sample.payload.to_bytes() == '{"name":"Käfig.c3d","bytes":7}'.encode()
    assert json.loads(sample.payload.to_bytes()) == file.description
    assert str(sample.encoding) == "application/json"
    assert sample.congestion_control == zenoh.CongestionControl.BLOCK
    assert sample.priority == zenoh.Priority.DATA_LOW


async def test_parameters_published_before_opening_follow_when_the_session_opens() -> None:
    lab = QueriedLab()
    lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
    lab.output.publish_parameters("lab", ServerParameters(XML, 1, 4))
    lab.output.announce_file("lab", ServerFile(Path("early.c3d"), 7))
    await asyncio.to_thread(lab.open)
    lab.subscribe("mocap/lab/*")
    await wait_until_async(lambda: lab.payloads("mocap/lab/parameters"))
    assert set(lab.payloads("mocap/lab/parameters")) == {XML}
    await lab.stop()


async def test_a_source_that_returns_does_not_publish_its_old_parameters(lab: QueriedLab) -> None:
    lab.output.announce("hall")
    lab.output.publish_parameters("hall", ServerParameters(b"<old/>", 1, 4))
    await lab.query("mocap/hall/status")  # the thread sends the reply after the parameters
    lab.output.withdraw("hall")
    lab.output.announce("hall")
    lab.subscribe("mocap/**")
    lab.output.publish_parameters("lab", ServerParameters(XML, 1, 4))
    await wait_until_async(lambda: lab.payloads("mocap/lab/parameters"))
    await lab.query("mocap/hall/status")
    assert lab.payloads("mocap/hall/parameters") == []


async def test_an_output_without_queries_has_no_results() -> None:
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer")))
    output.publish_parameters("lab", ServerParameters(XML, 1, 4))
    output.announce_file("lab", ServerFile(Path("early.c3d"), 7))
    output.withdraw("lab")
    assert output.query_results is None
    await output.stop_queries()
    await asyncio.to_thread(output.close)


async def test_an_event_loop_that_has_ended_is_no_error(lab: QueriedLab) -> None:
    late = QueriedLab()
    late.output._loop = asyncio.new_event_loop()
    late.output._loop.close()
    late.output._declare_all(lab.peer)
    await late.stop()


async def test_what_zenoh_does_not_publish_is_counted_and_logged(
    lab: QueriedLab, caplog: pytest.LogCaptureFixture
) -> None:
    session = open_zenoh("client", connect=lab.endpoint)
    late, losses = QueriedLab(), Losses(logging.getLogger("test"), "lab, zenoh")
    late.output.count_losses("lab", losses)
    late.output._holder.session = session
    late.output._declare_all(session)
    await asyncio.sleep(0)  # the event loop publishes what was there before: nothing
    session.close()
    caplog.clear()
    late.output.publish_parameters("lab", ServerParameters(XML, 1, 1))
    late.output.announce_file("lab", ServerFile(Path("late.c3d"), 7))
    await wait_until_async(lambda: amounts(losses.report()) == {"put failed": (2, 0)})
    await late.stop()
    text = "lab, zenoh: Zenoh did not take parameters or an announcement: session closed"
    assert caplog.messages == [text]


async def test_parameters_at_a_time_that_zenoh_cannot_express_are_lost_and_no_defect(
    lab: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh would panic, and the log would ask the user to report that."""
    monkeypatch.setattr(time, "time", lambda: 2.0**32)
    lab.output.maintain()
    arrived = lab.output.publish_parameters("lab", ServerParameters(XML, 1, 4))
    assert arrived is not None
    await arrived
    assert lab.lost == {"put failed": (1, 0)}
