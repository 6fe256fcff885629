"""Parameters at each connection, of several streams, void, and given to peers."""

import asyncio
import logging
from itertools import combinations

import pytest

from gateway.errors import ClosedError, ParametersError, ReplyTimeoutError, ServerError
from gateway.queries.answers import MAX_PARTS
from gateway.queries.parameter_cache import ParameterCache
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.session.replies import LONG_XML_BYTES, XmlThread
from tests.support.errors import names
from tests.support.parameters import in_root
from tests.support.records import kinds, logged
from tests.unit.queries.fake_source import CM, MM, FakeSource, parameters_xml

SILENCE = ReplyTimeoutError("192.0.2.1:3020 did not answer SendParameters within 2 s")
GARBAGE = b"It is 3 o'clock."

no_parameters = pytest.mark.parametrize("reply", [ServerError("err-what?"), SILENCE, GARBAGE])


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the warnings about parameters, not those about lost connections."""
    return [
        record.message
        for record in caplog.records
        if record.levelno == logging.WARNING and record.name.startswith("gateway.queries")
    ]


# At each connection --------------------------------------------------------------------------


async def test_parameters_are_announced_at_every_connection_and_statistics_are_no_change(
    source: FakeSource,
) -> None:
    other = parameters_xml("mm", frames_sent=7)
    for xml in (MM, other, CM):
        await source.connect(xml)
    assert source.announced == [(MM, 1), (MM, 1), (other, 1), (CM, 2)]
    assert (await source.parameters()).session == 4


@no_parameters
async def test_a_server_without_parameters_makes_the_former_ones_void(
    source: FakeSource, reply: bytes | Exception, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises((ServerError, ReplyTimeoutError, ParametersError)):
        await source.connect(reply)
    assert source.announced == [(MM, 1), (None, 2)]
    assert kinds(caplog) == [("WARNING", "void")]
    with pytest.raises((ServerError, ReplyTimeoutError, ParametersError)):
        await source.connect(reply)
    assert len(source.announced) == 2
    await source.connect(MM)
    assert source.announced[2:] == [(MM, 3)]


async def test_a_lost_connection_keeps_the_parameters(source: FakeSource) -> None:
    with pytest.raises(ClosedError):
        await source.connect(ClosedError("closed"))
    source.disconnect()
    assert source.announced == [(MM, 1)]
    assert (await source.parameters(stale_ok=True)).xml == MM


@pytest.mark.parametrize(
    ("reply", "code", "value"),
    [
        (ServerError("err-what?"), "refused", "err-what?"),
        (SILENCE, "timeout", "SendParameters"),
    ],
)
async def test_peers_are_told_that_the_parameters_are_void(
    source: FakeSource, reply: Exception, code: str, value: str
) -> None:
    with pytest.raises(type(reply)):
        await source.connect(reply)
    for sections in ((), ("3d",)):
        error = await source.parameters_error(*sections)
        assert error.code == code
        assert names(str(error), "lab", value)


async def test_xml_that_cannot_be_read_is_given_to_peers_as_it_is() -> None:
    source = FakeSource()
    with pytest.raises(ParametersError):
        await source.connect(GARBAGE)
    answer = await source.parameters()
    assert (answer.xml, answer.is_readable, answer.json) == (GARBAGE, False, None)
    assert source.server.commands == ["SendParameters"]


async def test_a_reload_continues_the_version(source: FakeSource) -> None:
    await source.connect(CM)
    after = FakeSource()
    after.queries.parameters = ParameterCache(
        after.queries.settings, after.queries._requests, after._announce, source.query_history
    )
    await after.store_parameters(CM)
    await after.connect(MM)
    assert after.announced == [(CM, 2), (MM, 3)]


# Several streams -----------------------------------------------------------------------------


async def connect_both(source: FakeSource) -> list[asyncio.Task[None]]:
    """Connect both streams; return when both wait for the server's answer."""
    tasks = [asyncio.create_task(connect(None)) for connect in (source.connect, source.connect_second)]
    await source.server.wait_for_commands(1)
    await asyncio.sleep(0)
    return tasks


async def test_streams_that_connect_at_the_same_time_share_one_request() -> None:
    source = FakeSource(two_streams=True)
    tasks = await connect_both(source)
    source.server.answer(MM)
    await asyncio.gather(*tasks)
    assert source.server.commands == ["SendParameters"]
    assert source.announced == [(MM, 1), (MM, 1)]
    assert (await source.parameters()).session == 3


@pytest.mark.parametrize("reply", [ServerError("err-what?"), SILENCE])
async def test_streams_that_connect_at_the_same_time_share_a_refusal(reply: Exception) -> None:
    source = FakeSource(two_streams=True)
    tasks = await connect_both(source)
    source.server.unanswered.popleft().set_exception(reply)
    assert await asyncio.gather(*tasks, return_exceptions=True) == [reply] * 2
    assert source.server.commands == ["SendParameters"]


@pytest.mark.parametrize("is_cancelled", [False, True])
async def test_a_stream_asks_itself_if_the_other_connection_ends(is_cancelled: bool) -> None:
    source = FakeSource(two_streams=True)
    first, second = await connect_both(source)
    if is_cancelled:
        first.cancel()
    else:
        source.server.unanswered.popleft().set_exception(ClosedError("closed"))
    await source.server.wait_for_commands(2)
    source.server.unanswered.pop().set_result(Packet(PacketType.XML, MM))
    await second
    await asyncio.gather(first, return_exceptions=True)
    assert source.server.commands == ["SendParameters"] * 2
    assert source.announced == [(MM, 1)]


async def test_a_second_connection_need_not_ask_again_for_a_while() -> None:
    source = FakeSource(two_streams=True, fresh_interval_s=3600.0)
    await source.store_parameters(MM)
    before = (await source.parameters()).session
    await source.connect_second(CM)
    assert source.server.commands == []
    assert source.announced == [(MM, 1), (MM, 1)]
    assert (await source.parameters()).session == before + 1


async def test_a_second_connection_asks_if_the_first_one_has_ended() -> None:
    source = FakeSource(two_streams=True, fresh_interval_s=3600.0)
    await source.store_parameters(MM)
    source.disconnect()
    await source.connect_second(CM)  # the server may be another one
    assert source.announced == [(MM, 1), (CM, 2)]


async def test_parameters_are_not_void_while_another_connection_gives_them() -> None:
    source = FakeSource(two_streams=True)
    await source.store_parameters(MM)
    with pytest.raises(ServerError):
        await source.connect_second(ServerError("only one client"))
    assert source.announced == [(MM, 1)]
    assert (await source.parameters()).xml == MM
    with pytest.raises(ServerError):
        await source.connect(ServerError("only one client"))
    assert source.announced == [(MM, 1), (None, 2)]


# Reading again -------------------------------------------------------------------------------


async def test_changes_are_announced(source: FakeSource) -> None:
    await source.refresh(CM)
    await source.refresh()
    assert source.announced == [(MM, 1), (CM, 2)]
    assert (await source.parameters()).xml == CM
    assert source.server.commands == ["SendParameters"] * 2


async def test_a_change_of_the_statistics_is_not_announced_but_answered(source: FakeSource) -> None:
    await source.refresh(parameters_xml("mm", frames_sent=2))
    assert source.announced == [(MM, 1)]
    answer = await source.parameters()
    assert answer.xml == parameters_xml("mm", frames_sent=2)
    general = answer.parsed.parameters.general
    assert general is not None
    assert general.frames_sent == 2
    await source.refresh(b"\n" + parameters_xml("mm", frames_sent=3))
    assert source.announced == [(MM, 1)]


async def test_another_frame_of_poses_is_another_version_of_the_parameters(source: FakeSource) -> None:
    await source.queries.parameters.begin_version()
    assert source.announced == [(MM, 1), (MM, 2)]
    assert (await source.parameters()).version == 2


async def test_no_section_goes_with_a_version_of_another_frame_of_poses(source: FakeSource) -> None:
    """Who compares the version with that of frames would wait for parameters that never come."""
    source.server.replies["SendParameters 6D"] = in_root("<The_6D/>")
    assert (await source.parameters("6d")).version == 1
    await source.queries.parameters.begin_version()
    assert (await source.parameters("6d")).version == 2


async def test_the_parameters_are_not_read_again_where_the_server_does_not_give_them() -> None:
    source = FakeSource()
    await source.refresh()
    with pytest.raises(ServerError):
        await source.connect(ServerError("err-what?"))
    await source.refresh()
    assert source.server.commands == ["SendParameters"]


async def test_a_server_that_was_silent_in_the_handshake_is_asked_once_more() -> None:
    """It may have hung for a moment. Where it does not know SendParameters, once more is enough."""
    source = FakeSource()
    for later, num_asked in ((SILENCE, 1), (MM, 2)):  # those that it gives are read again
        with pytest.raises(ReplyTimeoutError):
            await source.connect(SILENCE)
        source.server.replies["SendParameters"] = later
        source.server.commands.clear()
        await source.refresh()
        assert source.server.commands == ["SendParameters"]
        await source.refresh()
        assert source.server.commands == ["SendParameters"] * num_asked
    assert source.announced == [(MM, 1)]


async def test_a_refusal_later_on_keeps_the_parameters_and_ends_the_reading(
    source: FakeSource, caplog: pytest.LogCaptureFixture
) -> None:
    source.server.replies["SendParameters"] = ServerError("busy")
    for _ in range(3):
        await source.refresh()
    assert source.server.commands == ["SendParameters"]
    assert (await source.parameters()).xml == MM
    assert source.announced == [(MM, 1)]
    [warning] = logged(caplog)
    assert (warning.level, warning.args[0]) == ("WARNING", "lab")
    source.server.replies["SendParameters"] = CM
    assert (await source.parameters(fresh=True)).xml == CM  # a peer may ask nevertheless
    await source.refresh()
    assert source.server.commands == ["SendParameters"] * 3


@pytest.mark.parametrize("reply", [SILENCE, GARBAGE])
async def test_no_answer_later_on_keeps_the_parameters_and_is_logged_once(
    source: FakeSource, reply: bytes | Exception, caplog: pytest.LogCaptureFixture
) -> None:
    source.server.replies["SendParameters"] = reply
    for _ in range(3):
        await source.refresh()
    assert source.server.commands == ["SendParameters"] * 3
    assert (await source.parameters()).xml == MM
    assert source.announced == [(MM, 1)]
    assert len(warnings_of(caplog)) == 1


async def test_an_answer_to_a_peer_is_read_again_later() -> None:
    source = FakeSource()
    with pytest.raises(ReplyTimeoutError):
        await source.connect(SILENCE)
    source.server.replies["SendParameters"] = MM
    assert (await source.parameters()).xml == MM
    assert source.announced == [(MM, 1)]
    await source.refresh(CM)
    assert source.announced == [(MM, 1), (CM, 2)]


@pytest.mark.parametrize(
    ("before", "after", "level", "kind", "values"),
    [
        ("A B", "A C", "WARNING", "renamed", ["3d", "'B'", "'C'", 2]),
        ("A B", "A B C", "INFO", "changed", ["3d", 2]),
    ],
)
async def test_changes_are_logged(
    before: str, after: str, level: str, kind: str, values: list[object], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    source = FakeSource()
    await source.store_parameters(labelled(before))
    await source.refresh(labelled(after))
    [record] = [record for record in caplog.records if record.name == "gateway.queries.answers"]
    assert kinds(caplog, logging.INFO) == [(level, kind)]
    assert names(record.message, "lab", *values)


def labelled(labels: str) -> bytes:
    markers = "".join(f"<Marker id='1'><Label>{label}</Label></Marker>" for label in labels.split())
    return in_root(f"<The_3D><Markers>{markers}</Markers></The_3D>")


async def test_xml_that_could_not_be_read_is_not_returned_after_some_that_could() -> None:
    """The stream that has sent both may end; another server's trouble of an hour ago helps nobody."""
    source = FakeSource(two_streams=True)
    await source.store_parameters(MM)
    with pytest.raises(ReplyTimeoutError):
        await source.connect_second(SILENCE)
    await source.refresh(GARBAGE)
    await source.refresh(MM)
    source.disconnect()
    source.server.replies["SendParameters"] = CM
    assert (await source.parameters()).xml == CM


async def test_parameters_that_a_second_connection_shares_are_valid_as_long_as_that() -> None:
    """The first one may reconnect while the server is busy; names and units must not be void meanwhile."""
    source = FakeSource(two_streams=True, fresh_interval_s=3600.0)
    await source.store_parameters(MM)
    await source.connect_second(SILENCE)
    await source.connect(SILENCE)
    assert source.server.commands == []
    assert {xml for xml, _ in source.announced} == {MM}


# Peers ---------------------------------------------------------------------------------------


async def test_a_section_is_taken_from_all_parameters(source: FakeSource) -> None:
    for _ in range(2):
        section = await source.parameters("3d")
        assert parse_parameters(section.xml).parameters.markers is not None
        assert parse_parameters(section.xml).parameters.general is None
    some, everything = (await source.parameters("general", "3d")).json, (await source.parameters()).json
    assert some is not None
    assert everything is not None
    assert some.make() == everything.make()
    assert source.server.commands == []
    source.server.replies["SendParameters"] = CM
    fresh = await source.parameters("3d", fresh=True)
    assert b"<Unit>cm</Unit>" in fresh.xml
    assert source.server.commands == ["SendParameters"]


async def test_answers_for_some_sections_are_kept_up_to_a_limit(source: FakeSource) -> None:
    general = await source.parameters("general")
    both = await source.parameters("general", "3d")
    assert (await source.parameters("general", "3d")) is both
    everything = await source.parameters()
    for size in (1, 2, 3):
        for sections in combinations(("3d", "6d", "analog", "force", "events"), size):
            await everything.part(sections, XmlThread("test"))
    assert len(everything._parts) == MAX_PARTS
    assert (await source.parameters("general")) is not general


async def test_a_section_that_is_missing_is_requested_once(source: FakeSource) -> None:
    tools = source.server.replies["SendParameters 6D"] = in_root("<The_6D/>")
    assert (await source.parameters("6d")).xml == tools
    assert (await source.parameters("6d")).xml == tools
    assert source.server.commands == ["SendParameters 6D"]
    source.server.replies["SendParameters"] = CM
    await source.parameters(fresh=True)
    assert (await source.parameters("6d")).xml == tools
    assert source.server.commands[1:] == ["SendParameters", "SendParameters 6D"]  # asked again after a change
    tools = source.server.replies["SendParameters 6D"] = in_root("<The_6D><Tools/></The_6D>")
    assert (await source.parameters("6d", fresh=True)).xml == tools


async def test_a_section_that_a_lost_connection_prevents_is_an_error_and_asked_for_again(
    source: FakeSource,
) -> None:
    source.server.replies["SendParameters 6D"] = ClosedError("closed")
    assert (await source.parameters_error("6d")).code == "no-connection"
    tools = source.server.replies["SendParameters 6D"] = in_root("<The_6D/>")
    assert (await source.parameters("6d")).xml == tools


async def test_a_section_of_malformed_xml_is_requested() -> None:
    source = FakeSource()
    await source.store_parameters(MM.replace(b"</Unit>", b""))
    source.server.replies["SendParameters 3D"] = in_root("<The_3D/>")
    assert (await source.parameters("3d")).xml == in_root("<The_3D/>")


@pytest.mark.parametrize("problem", [ServerError("err-what?"), ReplyTimeoutError("did not answer")])
async def test_a_server_without_single_sections_is_not_asked_again_in_the_connection(
    source: FakeSource, problem: Exception
) -> None:
    source.server.replies["SendParameters 6D"] = problem
    assert (await source.parameters("6d")).xml == MM
    assert (await source.parameters("force")).xml == MM
    assert source.server.commands == ["SendParameters 6D"]
    await source.connect(MM)
    source.server.replies["SendParameters 6D"] = in_root("<The_6D/>")
    assert (await source.parameters("6d")).xml == in_root("<The_6D/>")  # another server may know sections


async def test_stale_parameters_are_returned_only_without_a_connection(source: FakeSource) -> None:
    source.disconnect()
    assert (await source.parameters_error()).code == "no-connection"
    assert (await source.parameters(stale_ok=True, fresh=True)).xml == MM
    assert b"<Unit>mm</Unit>" in (await source.parameters("3d", stale_ok=True)).xml
    assert (await source.parameters_error("6d", stale_ok=True)).code == "no-connection"
    await source.connect(CM)
    assert (await source.parameters(stale_ok=True)).xml == CM


@pytest.mark.parametrize("fresh_interval_s", [0.0, 3600.0])
async def test_the_last_answer_is_returned_unless_a_fresh_one_is_asked_for_after_the_interval(
    fresh_interval_s: float,
) -> None:
    requests = [] if fresh_interval_s else ["SendParameters"]
    source = FakeSource(fresh_interval_s=fresh_interval_s)
    await source.store_parameters(MM)
    cached = await source.parameters()
    assert (cached.xml, cached.session, cached.version, cached.age_s >= 0) == (MM, 1, 1, True)
    assert source.server.commands == []
    assert (await source.parameters(fresh=True)).xml == MM
    assert source.server.commands == requests


@pytest.mark.parametrize("fresh_interval_s", [0.0, 3600.0])
async def test_a_refusal_is_cached_for_the_connection_unless_the_query_is_fresh(
    fresh_interval_s: float,
) -> None:
    requests = [] if fresh_interval_s else ["SendParameters"]
    source = FakeSource(fresh_interval_s=fresh_interval_s)
    with pytest.raises(ServerError):
        await source.connect(ServerError("err-what?"))
    assert source.announced == []
    errors = [await source.parameters_error(*sections) for sections in ((), (), ("3d",))]
    assert [error.code for error in errors] == ["refused"] * 3
    assert all(names(str(error), "lab", "SendParameters", "err-what?") for error in errors)
    assert source.server.commands == ["SendParameters"]
    assert (await source.parameters_error(fresh=True)).code == "refused"
    assert source.server.commands == ["SendParameters", *requests]
    with pytest.raises(ReplyTimeoutError):
        await source.connect(SILENCE)
    source.server.replies["SendParameters"] = MM
    assert (await source.parameters()).xml == MM


async def test_xml_is_parsed_in_a_thread_and_only_its_statistics_if_nothing_else_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parsed: list[bytes] = []

    def parse(xml: bytes) -> ParsedParameters:
        with pytest.raises(RuntimeError, match="no running event loop"):
            asyncio.get_running_loop()
        parsed.append(xml)
        return parse_parameters(xml)

    monkeypatch.setattr("gateway.queries.answers.parse_parameters", parse)
    source = FakeSource()
    long = parameters_xml("mm") + b" " * LONG_XML_BYTES
    await source.store_parameters(long)
    await source.refresh(long.replace(b">1<", b">2<"))
    assert parsed[0] == long
    assert all(len(xml) < 1000 for xml in parsed[1:])  # the statistics alone
