import asyncio
import json
from collections.abc import Mapping
from typing import Any

import pytest

from gateway.config.settings import OutputSettings, SourceSettings
from gateway.errors import QueryError, ServerError
from gateway.messages.decode import JSON, XML
from gateway.messages.encode import Stamp, encode_message, with_sequence
from gateway.outputs.contract import Answer
from gateway.outputs.kind import OutputKind
from gateway.outputs.registry import OUTPUTS
from gateway.queries.questions import Question
from gateway.queries.server_requests import ParameterRefresh
from gateway.queries.service import SourceQueryService
from gateway.rtc3d.commands import SendCurrentFrame
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters import SECTIONS
from gateway.session.state import StreamState
from tests.support.clocks import run_in_virtual_time
from tests.support.errors import raises
from tests.support.servers import markers_frame
from tests.support.toy_output import ToyOutput
from tests.unit.queries.fake_source import CM, MM, FakeSource

FRAME = markers_frame(7, (1.0, 2.0, 3.0))[8:]


async def test_parameters_are_answered_with_their_xml_age_session_and_version(source: FakeSource) -> None:
    answer = await source.answer("parameters")
    assert (answer.payload, answer.encoding) == (MM, XML)
    assert answer.attachment.keys() == {"age_s", "session", "parameters_version", "frame"}
    assert (answer.attachment["session"], answer.attachment["parameters_version"]) == (1, 1)


async def test_stale_parameters_are_marked_as_stale(source: FakeSource) -> None:
    source.server.is_connected = False
    answer = await source.answer("parameters", stale_ok=True)
    assert answer.attachment["stale"] is True


async def test_parameters_are_converted_to_json_once(source: FakeSource) -> None:
    first = await source.answer("parameters", as_json=True)
    second = await source.answer("parameters", as_json=True)
    assert first.payload is second.payload
    assert first.encoding == JSON
    assert json.loads(first.payload)["3d"]["unit"] == "mm"
    assert first.attachment["recovered"] == []


@pytest.mark.parametrize(
    ("xml", "code", "value"),
    [
        (b"It is 3 o'clock.", "unreadable", "format=json"),
        (MM, "nothing-yet", "6d"),
    ],
)
async def test_parameters_that_cannot_be_converted_to_json_are_an_error(
    source: FakeSource, xml: bytes, code: str, value: str
) -> None:
    source.server.replies["SendParameters 6D"] = xml
    assert (await source.answer("parameters", "6d")).payload == xml
    with raises(QueryError, value, code=code):
        await source.answer("parameters", "6d", as_json=True)


async def test_a_file_is_read_once_for_simultaneous_queries() -> None:
    source = FakeSource()
    answers = await asyncio.gather(*(source.answer("c3d") for _ in range(10)))
    assert [answer.payload for answer in answers] == [b"file"] * 10
    assert source.num_file_reads == 1


def markers_message(session: int) -> bytes:
    [component] = split_frame(FRAME, "big").components
    return encode_message(component, Stamp(1, 1, session, 1), 5)


async def test_while_streaming_a_component_is_answered_with_its_newest_message() -> None:
    source = FakeSource()
    source.status.state = StreamState.STREAMING
    source.newest_messages[ComponentType.MARKERS] = markers_message(session=1)
    answer = await source.answer("component", "3d")
    assert answer.payload == markers_message(session=1)
    assert answer.attachment == {"session": 1, "parameters_version": 1}
    assert source.server.commands == []


async def test_a_message_of_an_earlier_session_is_not_an_answer() -> None:
    source = FakeSource()
    source.status.state = StreamState.STREAMING
    source.status.session = 2
    source.newest_messages[ComponentType.MARKERS] = markers_message(session=1)
    with raises(QueryError, "3d", "lab", code="nothing-yet"):
        await source.answer("component", "3d")
    assert source.server.commands == []


async def test_simultaneous_queries_for_the_current_frame_share_one_request() -> None:
    source = FakeSource()
    source.server.replies["SendCurrentFrame 3D"] = Packet(PacketType.DATA, FRAME)
    answers = await asyncio.gather(*(source.answer("component", "3d", as_json=True) for _ in range(5)))
    assert {json.loads(answer.payload)["frame_number"] for answer in answers} == {7}
    assert source.server.commands == ["SendCurrentFrame 3D"]


async def test_a_server_that_does_not_know_a_component_is_asked_for_the_whole_frame() -> None:
    source = FakeSource()
    source.server.replies["SendCurrentFrame 3D"] = ServerError("err-what?")
    source.server.replies[str(SendCurrentFrame())] = Packet(PacketType.DATA, FRAME)
    assert (await source.answer("component", "3d")).encoding == "application/x-lcm;rtc3d.markers_t"


async def test_the_json_of_a_message_has_the_number_on_the_output_of_the_query() -> None:
    source = FakeSource()
    source.status.state = StreamState.STREAMING
    answers = {}
    for output in ("lcm", "zenoh"):
        source.newest_messages[ComponentType.MARKERS] = with_sequence(markers_message(1), len(output))
        answers[output] = await source.queries.answer(Question("component", "3d", as_json=True), output)
    assert [json.loads(answers[output].payload)["sequence"] for output in answers] == [3, 5]


@pytest.mark.parametrize(
    ("packet", "code", "values"),
    [
        (Packet(PacketType.NO_DATA, b""), "nothing-yet", []),
        (Packet(PacketType.DATA, b"\0\0\0\0"), "nothing-yet", ["3d"]),
        (Packet(PacketType.DATA, FRAME[:-1]), "unreadable", []),
    ],
)
async def test_a_current_frame_without_the_component_is_an_error(
    packet: Packet, code: str, values: list[str]
) -> None:
    source = FakeSource()
    source.server.replies["SendCurrentFrame 3D"] = packet
    with raises(QueryError, *values, code=code):
        await source.answer("component", "3d")


# When the parameters are read again, in virtual time ----------------------------------------


async def readings_s(request_s: float, **settings: Any) -> list[int]:
    """Return the times of all readings, with a request at one time, and another reading after 4 s."""
    loop = asyncio.get_running_loop()
    started_s, readings_s = loop.time(), list[int]()

    async def read() -> None:
        readings_s.append(round(loop.time() - started_s))
        if len(readings_s) > 9:
            task.cancel()  # time would stand still

    source_settings = SourceSettings(name="lab", host="192.0.2.1", **settings)
    refresh = ParameterRefresh(source_settings, read, lambda: started_s + 4.0)
    task = asyncio.create_task(refresh.run())
    loop.call_later(request_s, refresh.request)
    await asyncio.sleep(30.0)
    task.cancel()
    return readings_s


def test_an_answer_for_another_reason_delays_the_next_reading() -> None:
    """So the server is not asked for what it has just sent."""
    assert run_in_virtual_time(readings_s(99.0, parameters_interval_s=10.0)) == [14, 24]


def test_without_an_interval_the_parameters_are_read_on_request_only() -> None:
    assert run_in_virtual_time(readings_s(5.0, parameters_interval_s=0.0)) == [6]


async def trim(source: str, options: Mapping[str, str]) -> Answer:
    return Answer(f"{source} {dict(options)}".encode(), "text/plain")


def service_of(source: FakeSource) -> SourceQueryService:
    return SourceQueryService(lambda: {"lab": source.queries}, lambda: {"record/trim": trim}, "zenoh")


async def test_a_command_of_an_output_gets_the_source_and_the_options() -> None:
    service = service_of(FakeSource())
    answer = await service.answer("lab", ("record", "trim"), {"to": "5"})
    assert answer.payload == b"lab {'to': '5'}"
    assert service.accepted_keys("lab").endswith(", schema/TYPE, record/trim")
    assert [service.serves(source) for source in ("lab", "hall")] == [True, False]


async def test_a_wildcard_selects_components_of_the_source_and_no_commands() -> None:
    keys = service_of(FakeSource()).keys("lab")
    assert {("parameters",), ("3d",)} <= {*keys}
    assert {*keys}.isdisjoint({("analog",), ("recording",), ("record", "trim")})


@pytest.mark.parametrize(
    ("path", "options"),
    [
        (("recording",), {"set": "start"}),
        (("record", "trim"), {"set": "start"}),
        (("record", "trim"), {"set": ""}),
    ],
)
async def test_what_changes_something_needs_remote_control(
    path: tuple[str, ...], options: dict[str, str]
) -> None:
    source = FakeSource()
    with raises(QueryError, "remote_control: true", code="refused"):
        await service_of(source).answer("lab", path, options)
    assert source.recorded == []


async def test_four_commands_a_second_may_change_something() -> None:
    service = service_of(FakeSource(remote_control=True))
    for _ in range(4):
        await service.answer("lab", ("record", "trim"), {"set": "start"})
    with raises(QueryError, "lab", 4, code="rate"):
        await asyncio.gather(*(service.answer("lab", ("recording",), {"set": "start"}) for _ in range(4)))
    await service.answer("lab", ("record", "trim"), {})


async def test_a_stop_passes_however_many_commands_came_before() -> None:
    """Of five starts and stops at once, the third start passed and its stop did not."""
    source = FakeSource(remote_control=True)
    service = service_of(source)

    async def ask(action: str) -> str:
        try:
            await service.answer("lab", ("recording",), {"set": action})
        except QueryError as error:
            return error.code
        return "ok"

    answers = await asyncio.gather(*(ask(action) for _ in range(5) for action in ("start", "stop")))
    assert answers[1::2] == ["ok"] * 5
    assert source.recorded[-1] is False
    await service.answer("lab", ("record", "trim"), {"set": "stop"})


async def test_what_a_peer_has_started_may_be_stopped_after_remote_control_is_off() -> None:
    """A reload between start and stop must not leave a server that records on."""
    source = FakeSource(remote_control=True)
    service = service_of(source)
    await service.answer("lab", ("recording",), {"set": "start"})
    source.queries.settings = source.queries.settings.model_copy(update={"remote_control": False})
    with raises(QueryError, code="refused"):
        await service.answer("lab", ("record", "trim"), {"set": "start"})
    await service.answer("lab", ("recording",), {"set": "stop"})
    with raises(QueryError, code="refused"):
        await service.answer("lab", ("recording",), {"set": "stop"})
    assert source.recorded == [True, False]


async def test_a_wrong_command_is_no_command_that_changes_something() -> None:
    service = service_of(FakeSource(remote_control=True))
    for _ in range(10):
        with raises(QueryError, "start, stop", code="bad-request"):
            await service.answer("lab", ("recording",), {"set": "pause"})
    with raises(QueryError, "'set'", "status", code="bad-request"):
        await service.answer_all("lab", [("status",)], {"set": "start"})


async def test_the_command_of_an_output_that_is_off_is_an_error_that_says_what_to_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(OUTPUTS, "toy", OutputKind("toy", OutputSettings, ToyOutput, commands=("play",)))
    with raises(QueryError, "play", "toy.enabled: true", code="disabled"):
        await service_of(FakeSource()).answer("lab", ("play",), {"set": "start"})
    assert service_of(FakeSource()).commands()[:2] == ["recording", "record/trim"]
    assert "play" in service_of(FakeSource()).commands()


async def test_keys_without_an_answer_are_left_out_if_another_key_has_one() -> None:
    source = FakeSource()
    source.server.is_connected = False
    answers = await service_of(source).answer_all("lab", [("3d",), ("c3d",), ("status",)], {})
    assert answers.keys() == {("c3d",), ("status",)}


async def test_the_first_error_is_raised_if_no_key_has_an_answer() -> None:
    source = FakeSource()
    source.server.replies = {"SendParameters": ServerError("err-no"), "SendCurrentFrame": ServerError("b")}
    source.server.replies["SendCurrentFrame 3D"] = ServerError("a")
    with raises(QueryError, "SendParameters", "err-no", code="refused"):
        await service_of(source).answer_all("lab", [("parameters",), ("3d",)], {})


async def test_a_defect_in_one_answer_is_raised_although_others_have_an_answer() -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = ZeroDivisionError("a defect")
    with pytest.raises(ZeroDivisionError):
        await service_of(source).answer_all("lab", [("parameters",), ("c3d",)], {})


async def test_sections_are_checked_before_the_server_is_asked() -> None:
    source = FakeSource()
    with raises(QueryError, "'4d'", "general, 3d", code="bad-request"):
        await service_of(source).parameters("lab", ["3d", "4d"], fresh=True)
    assert source.server.commands == []


async def test_sections_are_requested_in_the_order_of_the_specification() -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = MM  # without Force
    source.server.replies["SendParameters 3D Force"] = CM
    parameters = await service_of(source).parameters("lab", ["force", "3d", "3d"], fresh=False)
    assert (parameters.xml, parameters.session) == (CM, 1)


@pytest.mark.parametrize("sections", [(), tuple(SECTIONS), tuple(reversed(SECTIONS))])
async def test_a_request_for_all_sections_is_a_request_for_all_parameters(sections: tuple[str, ...]) -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = MM
    await service_of(source).parameters("lab", sections, fresh=False)
    assert source.server.commands == ["SendParameters"]
