"""Parameters at the queries: what is known, asked for, remembered, told."""

import asyncio
import contextlib
import json
import re

import pytest

from gateway.errors import ClosedError, ReplyTimeoutError, ServerError
from gateway.queries.source_queries import LONG_XML_BYTES
from gateway.rtc3d.parameters import SECTIONS
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from tests.unit.queries.rig import Rig, xml_of
from tests.waiting import wait_until_async


async def test_what_is_known_is_given_without_asking() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    known = await rig.parameters()
    assert (known.xml, known.session) == (xml_of("mm"), 1)
    assert known.age_s >= 0
    assert rig.server.commands == []
    assert rig.queries.parameters_xml == xml_of("mm")


async def test_what_is_not_known_is_asked_for_and_then_known() -> None:
    rig = Rig()
    rig.server.replies["SendParameters 3D"] = xml_of("mm")
    assert (await rig.parameters("3d")).xml == xml_of("mm")
    assert (await rig.parameters("3d")).xml == xml_of("mm")
    assert rig.server.commands == ["SendParameters 3D"]


async def test_what_another_connection_said_is_asked_for_again() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    rig.status.session = 2
    rig.server.replies["SendParameters"] = xml_of("cm")
    assert (await rig.parameters()).xml == xml_of("cm")


async def test_equal_questions_share_one_answer_and_different_ones_wait_for_each_other() -> None:
    rig = Rig()
    asks = [asyncio.create_task(rig.parameters("3d", fresh=True)) for _ in range(5)]
    asks += [asyncio.create_task(rig.parameters("6d", fresh=True)) for _ in range(5)]
    await rig.asked(1)
    await asyncio.sleep(0)
    assert rig.server.commands == ["SendParameters 3D"]  # one at a time
    rig.server.answer(xml_of("mm"))
    await rig.asked(2)
    rig.server.answer(xml_of("cm"))
    known = await asyncio.gather(*asks)
    assert [each.xml for each in known] == [xml_of("mm")] * 5 + [xml_of("cm")] * 5
    assert rig.server.commands == ["SendParameters 3D", "SendParameters 6D"]
    assert len({id(each) for each in known}) == 2  # parsed once for all


async def test_who_gives_up_takes_no_answer_from_the_others() -> None:
    rig = Rig()
    hasty, patient = (asyncio.create_task(rig.parameters()) for _ in range(2))
    await rig.asked(1)
    hasty.cancel()
    rig.server.answer(xml_of("mm"))
    assert (await patient).xml == xml_of("mm")
    with contextlib.suppress(asyncio.CancelledError):
        await hasty


async def test_within_the_interval_an_answer_counts_as_fresh() -> None:
    rig = Rig(fresh_interval_s=3600.0)
    rig.learn(xml_of("mm"))
    assert (await rig.parameters(fresh=True)).xml == xml_of("mm")
    assert rig.server.commands == []


async def test_a_refusal_is_remembered_as_long_as_the_connection_and_asked_anew_if_fresh() -> None:
    rig = Rig()
    rig.server.replies["SendParameters"] = ServerError("err-what?")
    texts = {str(await rig.error()) for _ in range(3)}
    assert texts == {"source 'lab': the server does not know SendParameters, or refuses it: err-what?"}
    assert rig.server.commands == ["SendParameters"]
    assert (await rig.error(fresh=True)).code == "refused"
    assert rig.server.commands == ["SendParameters"] * 2
    rig.status.session = 2
    assert (await rig.error()).code == "refused"
    assert rig.server.commands == ["SendParameters"] * 3


async def test_within_the_interval_a_refusal_is_not_asked_for_again_even_if_fresh() -> None:
    rig = Rig(fresh_interval_s=3600.0)
    rig.server.replies["SendParameters"] = ServerError("err-what?")
    for _ in range(3):
        assert (await rig.error(fresh=True)).code == "refused"
    assert rig.server.commands == ["SendParameters"]


@pytest.mark.parametrize("problem", [ServerError("err-what?"), ReplyTimeoutError("did not answer")])
async def test_a_server_without_single_sections_is_asked_for_all_from_then_on(problem: Exception) -> None:
    rig = Rig()
    rig.server.replies = {"SendParameters 3D": problem, "SendParameters": xml_of("mm")}
    assert (await rig.parameters("3d")).xml == xml_of("mm")
    assert (await rig.parameters("6d")).xml == xml_of("mm")
    assert rig.server.commands == ["SendParameters 3D", "SendParameters", "SendParameters"]
    rig.status.session = 2
    rig.server.replies["SendParameters 3D"] = xml_of("cm")
    assert (await rig.parameters("3d")).xml == xml_of("cm")  # another connection may know them


async def test_a_server_that_says_nothing_leads_to_a_time_out_that_is_not_remembered() -> None:
    rig = Rig()
    rig.server.replies["SendParameters"] = ReplyTimeoutError("192.0.2.1:3020 did not answer")
    error = await rig.error()
    assert (error.code, str(error)) == ("timeout", "source 'lab': 192.0.2.1:3020 did not answer")
    rig.server.replies["SendParameters"] = xml_of("mm")
    assert (await rig.parameters()).xml == xml_of("mm")


async def test_a_question_waits_no_longer_than_configured() -> None:
    rig = Rig(query_timeout_s=0.05)
    error = await rig.error()
    assert error.code == "timeout"
    assert str(error) == "source 'lab': no answer within 0.05 s; questions waiting for the server: 1"
    rig.server.replies["SendParameters"] = xml_of("mm")
    assert (await rig.parameters()).xml == xml_of("mm")  # nobody is in its way


async def test_a_connection_lost_meanwhile_is_told() -> None:
    rig = Rig()
    rig.server.replies["SendParameters"] = ClosedError("the connection to 192.0.2.1:3020 was closed")
    error = await rig.error()
    assert error.code == "no-connection"
    assert str(error) == (
        "source 'lab' has just lost its connection: the connection to 192.0.2.1:3020 was closed"
    )


async def test_a_connection_lost_before_its_turn_is_told() -> None:
    rig = Rig()
    first = asyncio.create_task(rig.parameters("3d"))
    second = asyncio.create_task(rig.error("6d"))
    await rig.asked(1)
    rig.server.connected = False
    rig.server.answer(xml_of("mm"))
    await first
    assert (await second).code == "no-connection"
    assert rig.server.commands == ["SendParameters 3D"]


async def test_before_the_first_try_is_over_it_is_told_where_to() -> None:
    rig = Rig()
    rig.server.connected = False
    error = await rig.error()
    assert error.code == "no-connection"
    assert str(error) == "source 'lab' has no connection yet: connecting to 192.0.2.1:3020"


async def test_the_reason_the_age_and_the_remedy_are_told_while_there_is_no_connection() -> None:
    rig = Rig()
    rig.server.connected = False
    rig.status.record_error("connection refused by 192.0.2.1:3020; is the RT server running?")
    rig.status.last_error_utime -= 300_000_000
    problem, _, remedy = str(await rig.error(stale_ok=True)).partition("; ")
    assert re.fullmatch(
        r"source 'lab' has no connection: refused by 192.0.2.1:3020, tried 3..\.. s ago", problem
    )
    assert remedy == "is the RT server running?"


async def test_stale_parameters_are_given_only_while_there_is_no_connection() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    rig.server.connected = False
    assert (await rig.error()).code == "no-connection"
    assert (await rig.parameters(stale_ok=True, fresh=True)).xml == xml_of("mm")
    answer = await rig.ask("parameters", stale_ok=True)
    assert answer.attachment["stale"] is True
    rig.server.connected = True
    rig.status.session = 2
    rig.server.replies["SendParameters"] = xml_of("cm")
    answer = await rig.ask("parameters", stale_ok=True)
    assert answer.payload == xml_of("cm")
    assert "stale" not in answer.attachment


async def test_each_section_is_asked_for_once_to_fill_what_is_known() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    words = ("General", "3D", "6D", "Analog", "Force", "Events")
    rig.server.replies = {f"SendParameters {word}": xml_of("mm") for word in words}
    await rig.queries.fill_cache()
    assert rig.server.commands == [f"SendParameters {word}" for word in words]
    for section in SECTIONS:
        await rig.parameters(section)
    await rig.queries.fill_cache()
    assert len(rig.server.commands) == 6
    assert rig.changes == []


async def test_a_server_that_did_not_tell_its_parameters_is_not_asked_for_sections() -> None:
    rig = Rig()
    await rig.queries.fill_cache()
    rig.learn(xml_of("mm"))
    rig.status.session = 2
    await rig.queries.fill_cache()
    assert rig.server.commands == []


async def test_filling_ends_where_the_server_says_nothing() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    silence = ReplyTimeoutError("did not answer")
    rig.server.replies = {"SendParameters General": silence, "SendParameters": silence}
    await rig.queries.fill_cache()
    assert rig.server.commands == ["SendParameters General", "SendParameters"]


async def test_parameters_that_change_are_told_with_their_sections_forgotten() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    rig.server.replies = {"SendParameters": xml_of("cm"), "SendParameters 3D": xml_of("mm")}
    await rig.parameters("3d")
    await rig.parameters(fresh=True)
    assert rig.changes == [xml_of("cm")]
    rig.server.replies["SendParameters 3D"] = xml_of("cm")
    assert (await rig.parameters("3d")).xml == xml_of("cm")
    assert rig.changes == [xml_of("cm")]


async def test_statistics_that_change_are_no_change() -> None:
    rig = Rig()
    rig.learn(xml_of("mm", frames_sent=1))
    rig.server.replies["SendParameters"] = xml_of("mm", frames_sent=2)
    assert (await rig.parameters(fresh=True)).xml == xml_of("mm", frames_sent=2)
    assert rig.changes == []


async def test_a_section_that_changes_leads_to_a_question_for_all() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    rig.server.replies = {"SendParameters": xml_of("cm"), "SendParameters 3D": xml_of("mm")}
    await rig.parameters("3d")
    assert rig.server.commands == ["SendParameters 3D"]
    rig.server.replies["SendParameters 3D"] = xml_of("cm")
    await rig.parameters("3d", fresh=True)
    await wait_until_async(lambda: rig.changes == [xml_of("cm")])
    assert rig.server.commands == ["SendParameters 3D", "SendParameters 3D", "SendParameters"]


async def test_parameters_that_come_for_the_first_time_are_told() -> None:
    rig = Rig()
    rig.server.replies["SendParameters"] = xml_of("mm")
    await rig.parameters()
    assert rig.changes == [xml_of("mm")]


async def test_long_xml_is_parsed_outside_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    in_loop: list[bool] = []

    def parse(xml: bytes) -> ParsedParameters:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            in_loop.append(False)
        else:
            in_loop.append(True)
        return parse_parameters(xml)

    monkeypatch.setattr("gateway.queries.parameter_cache.parse_parameters", parse)
    rig = Rig()
    padding = b" " * LONG_XML_BYTES
    rig.server.replies = {"SendParameters 3D": xml_of("mm"), "SendParameters 6D": xml_of("mm") + padding}
    await rig.parameters("3d")
    assert (await rig.parameters("6d")).xml.endswith(padding)
    assert in_loop == [True, False]


async def test_json_is_made_once_for_all_who_ask() -> None:
    rig = Rig()
    rig.learn(xml_of("mm"))
    first = await rig.ask("parameters", as_json=True)
    second = await rig.ask("parameters", as_json=True)
    assert first.payload is second.payload
    assert json.loads(first.payload)["3d"]["unit"] == "mm"
