import asyncio

import pytest

from gateway.errors import ReplyTimeoutError, ServerError
from gateway.queries.parameter_cache import LONG_XML_BYTES
from gateway.rtc3d.parameters import SECTIONS
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from tests.unit.queries.fake_source import FakeSource, parameters_xml
from tests.waiting import wait_until_async


async def test_cached_parameters_are_returned_without_a_request() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    cached = await source.parameters()
    assert (cached.xml, cached.session) == (parameters_xml("mm"), 1)
    assert cached.age_s >= 0
    assert source.server.commands == []
    assert source.queries.parameters.xml == parameters_xml("mm")


async def test_missing_parameters_are_requested_once() -> None:
    source = FakeSource()
    source.server.replies["SendParameters 3D"] = parameters_xml("mm")
    assert (await source.parameters("3d")).xml == parameters_xml("mm")
    assert (await source.parameters("3d")).xml == parameters_xml("mm")
    assert source.server.commands == ["SendParameters 3D"]


async def test_parameters_of_an_earlier_connection_are_requested_again() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    source.status.session = 2
    source.server.replies["SendParameters"] = parameters_xml("cm")
    assert (await source.parameters()).xml == parameters_xml("cm")


async def test_an_answer_counts_as_fresh_within_the_interval() -> None:
    source = FakeSource(fresh_interval_s=3600.0)
    source.store_parameters(parameters_xml("mm"))
    assert (await source.parameters(fresh=True)).xml == parameters_xml("mm")
    assert source.server.commands == []


async def test_a_refusal_is_cached_for_the_connection_unless_the_query_is_fresh() -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = ServerError("err-what?")
    texts = {str(await source.parameters_error()) for _ in range(3)}
    assert texts == {"source 'lab': the server does not know SendParameters, or refuses it: err-what?"}
    assert source.server.commands == ["SendParameters"]
    assert (await source.parameters_error(fresh=True)).code == "refused"
    assert source.server.commands == ["SendParameters"] * 2
    source.status.session = 2
    assert (await source.parameters_error()).code == "refused"
    assert source.server.commands == ["SendParameters"] * 3


async def test_a_refusal_counts_as_fresh_within_the_interval() -> None:
    source = FakeSource(fresh_interval_s=3600.0)
    source.server.replies["SendParameters"] = ServerError("err-what?")
    for _ in range(3):
        assert (await source.parameters_error(fresh=True)).code == "refused"
    assert source.server.commands == ["SendParameters"]


@pytest.mark.parametrize("problem", [ServerError("err-what?"), ReplyTimeoutError("did not answer")])
async def test_a_server_without_single_sections_is_asked_for_all_for_the_rest_of_the_connection(
    problem: Exception,
) -> None:
    source = FakeSource()
    source.server.replies = {"SendParameters 3D": problem, "SendParameters": parameters_xml("mm")}
    assert (await source.parameters("3d")).xml == parameters_xml("mm")
    assert (await source.parameters("6d")).xml == parameters_xml("mm")
    assert source.server.commands == ["SendParameters 3D", "SendParameters", "SendParameters"]
    source.status.session = 2
    source.server.replies["SendParameters 3D"] = parameters_xml("cm")
    assert (await source.parameters("3d")).xml == parameters_xml("cm")  # another server may know sections


async def test_stale_parameters_are_returned_only_without_a_connection() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    source.server.is_connected = False
    assert (await source.parameters_error()).code == "no-connection"
    assert (await source.parameters(stale_ok=True, fresh=True)).xml == parameters_xml("mm")
    source.server.is_connected = True
    source.status.session = 2
    source.server.replies["SendParameters"] = parameters_xml("cm")
    assert (await source.parameters(stale_ok=True)).xml == parameters_xml("cm")


async def test_filling_the_cache_requests_each_section_once() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    words = ("General", "3D", "6D", "Analog", "Force", "Events")
    source.server.replies = {f"SendParameters {word}": parameters_xml("mm") for word in words}
    await source.queries.parameters.fill()
    assert source.server.commands == [f"SendParameters {word}" for word in words]
    for section in SECTIONS:
        await source.parameters(section)
    await source.queries.parameters.fill()
    assert len(source.server.commands) == 6
    assert source.changes == []


async def test_the_cache_is_not_filled_if_the_server_sent_no_parameters_in_this_connection() -> None:
    source = FakeSource()
    await source.queries.parameters.fill()
    source.store_parameters(parameters_xml("mm"))
    source.status.session = 2
    await source.queries.parameters.fill()
    assert source.server.commands == []


async def test_filling_the_cache_stops_when_the_server_does_not_answer() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    silence = ReplyTimeoutError("did not answer")
    source.server.replies = {"SendParameters General": silence, "SendParameters": silence}
    await source.queries.parameters.fill()
    assert source.server.commands == ["SendParameters General", "SendParameters"]


async def test_a_change_is_reported_and_clears_the_cached_sections() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    source.server.replies = {
        "SendParameters": parameters_xml("cm"),
        "SendParameters 3D": parameters_xml("mm"),
    }
    await source.parameters("3d")
    await source.parameters(fresh=True)
    assert source.changes == [parameters_xml("cm")]
    source.server.replies["SendParameters 3D"] = parameters_xml("cm")
    assert (await source.parameters("3d")).xml == parameters_xml("cm")
    assert source.changes == [parameters_xml("cm")]


async def test_a_change_of_the_statistics_is_not_reported() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm", frames_sent=1))
    source.server.replies["SendParameters"] = parameters_xml("mm", frames_sent=2)
    assert (await source.parameters(fresh=True)).xml == parameters_xml("mm", frames_sent=2)
    assert source.changes == []


async def test_a_change_of_a_section_leads_to_a_request_for_all_parameters() -> None:
    source = FakeSource()
    source.store_parameters(parameters_xml("mm"))
    source.server.replies = {
        "SendParameters": parameters_xml("cm"),
        "SendParameters 3D": parameters_xml("mm"),
    }
    await source.parameters("3d")
    assert source.server.commands == ["SendParameters 3D"]
    source.server.replies["SendParameters 3D"] = parameters_xml("cm")
    await source.parameters("3d", fresh=True)
    await wait_until_async(lambda: source.changes == [parameters_xml("cm")])
    assert source.server.commands == ["SendParameters 3D", "SendParameters 3D", "SendParameters"]


async def test_the_first_parameters_are_reported_as_a_change() -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = parameters_xml("mm")
    await source.parameters()
    assert source.changes == [parameters_xml("mm")]


async def test_long_xml_is_parsed_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    in_event_loop: list[bool] = []

    def parse(xml: bytes) -> ParsedParameters:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            in_event_loop.append(False)
        else:
            in_event_loop.append(True)
        return parse_parameters(xml)

    monkeypatch.setattr("gateway.queries.parameter_cache.parse_parameters", parse)
    source = FakeSource()
    padding = b" " * LONG_XML_BYTES
    source.server.replies = {
        "SendParameters 3D": parameters_xml("mm"),
        "SendParameters 6D": parameters_xml("mm") + padding,
    }
    await source.parameters("3d")
    assert (await source.parameters("6d")).xml.endswith(padding)
    assert in_event_loop == [True, False]
