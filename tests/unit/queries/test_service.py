import asyncio
from collections.abc import Mapping

import pytest

from gateway.config.settings import OutputSettings
from gateway.errors import QueryError, ServerError
from gateway.outputs.contract import Answer
from gateway.outputs.kind import OutputKind
from gateway.outputs.registry import OUTPUTS
from gateway.queries.service import SourceQueryService
from gateway.rtc3d.parameters import SECTIONS
from tests.toy_output import ToyOutput
from tests.unit.queries.fake_source import CM, MM, FakeSource


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
    with pytest.raises(QueryError, match="set remote_control: true for it in the gateway") as caught:
        await service_of(source).answer("lab", path, options)
    assert caught.value.code == "refused"
    assert source.recorded == []


async def test_four_commands_a_second_may_change_something() -> None:
    service = service_of(FakeSource(remote_control=True))
    for _ in range(4):
        await service.answer("lab", ("record", "trim"), {"set": "start"})
    with pytest.raises(QueryError, match="source 'lab' takes 4 commands a second") as caught:
        await asyncio.gather(*(service.answer("lab", ("recording",), {"set": "start"}) for _ in range(4)))
    assert caught.value.code == "rate"
    await service.answer("lab", ("record", "trim"), {})


async def test_a_wrong_command_is_no_command_that_changes_something() -> None:
    service = service_of(FakeSource(remote_control=True))
    for _ in range(10):
        with pytest.raises(QueryError, match="accepted: start, stop"):
            await service.answer("lab", ("recording",), {"set": "pause"})
    with pytest.raises(QueryError, match="unknown option 'set' of status"):
        await service.answer_all("lab", [("status",)], {"set": "start"})


async def test_the_command_of_an_output_that_is_off_is_an_error_that_says_what_to_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(OUTPUTS, "toy", OutputKind("toy", OutputSettings, ToyOutput, commands=("play",)))
    with pytest.raises(QueryError, match=r"to use play, set toy\.enabled: true in the gateway") as caught:
        await service_of(FakeSource()).answer("lab", ("play",), {"set": "start"})
    assert caught.value.code == "disabled"
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
    with pytest.raises(QueryError, match="SendParameters, or refuses it: err-no"):
        await service_of(source).answer_all("lab", [("parameters",), ("3d",)], {})


async def test_a_defect_in_one_answer_is_raised_although_others_have_an_answer() -> None:
    source = FakeSource()
    source.server.replies["SendParameters"] = ZeroDivisionError("a defect")
    with pytest.raises(ZeroDivisionError):
        await service_of(source).answer_all("lab", [("parameters",), ("c3d",)], {})


async def test_sections_are_checked_before_the_server_is_asked() -> None:
    source = FakeSource()
    with pytest.raises(QueryError, match="unknown section '4d'; accepted: general, 3d"):
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
