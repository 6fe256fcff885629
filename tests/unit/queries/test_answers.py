import json
import threading
from pathlib import Path

import pytest
import rtc3d

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import MAX_JSON_SOURCE_BYTES, TEXT
from gateway.messages.encode import Stamp, encode_message
from gateway.queries import answers
from gateway.queries.answers import (
    FilePayload,
    JsonPayload,
    NewestJson,
    frame_answer,
    message_answer,
    parameters_json,
    schema_answer,
)
from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import General, Parameters, ParametersForce
from tests.support.errors import raises
from tests.support.vectors import FULL_FRAME, MARKERS
from tests.unit.messages.samples import component_message


def encoded_message(component_type: ComponentType) -> bytes:
    components = split_frame(FULL_FRAME["big"], "big").components
    [component] = [component for component in components if component.type is component_type]
    return encode_message(component, Stamp(1, 2, 3, 4), 4)


@pytest.mark.parametrize("name", SCHEMA_TYPES)
def test_a_schema_contains_the_types_of_members_before_the_types_that_have_them(name: str) -> None:
    answer = schema_answer(name)
    text = answer.payload.decode()
    assert answer.encoding == TEXT
    types = [line.split()[1] for line in text.splitlines() if line.startswith("struct ")]
    assert types[-1] == name
    for at, each in enumerate(types):
        type_names = getattr(rtc3d, each).__typenames__
        members = {name.removeprefix("rtc3d.") for name in type_names if "." in name}
        assert members <= set(types[:at])
    assert len(set(types)) == len(types)


def test_a_message_is_returned_unchanged_with_its_type_as_encoding() -> None:
    message = encoded_message(ComponentType.FORCE)
    answer = message_answer(message, {"session": 3})
    assert answer.payload is message
    assert answer.encoding == "application/x-lcm;rtc3d.forces_t"
    assert answer.attachment == {"session": 3}


def test_a_message_as_json_has_null_for_missing_markers() -> None:
    _, payload = NewestJson().of("3d", encoded_message(ComponentType.MARKERS))
    value = json.loads(payload.make())
    assert (value["sequence"], value["session"], value["utime"]) == (4, 3, 1)
    missing = [marker for marker in value["markers"] if marker["x"] is None]
    assert missing
    assert {(marker["y"], marker["z"]) for marker in missing} == {(None, None)}


def test_parameters_as_json_have_the_sections_of_the_server() -> None:
    parameters = Parameters(general=General(name="Höhe"), force=ParametersForce())
    assert parameters_json(parameters, "") == (
        '{"general":{"name":"Höhe","version":"","address":"","port":null,"frames_sent":null,'
        '"frames_per_s":null},"force":{"plates":[]}}'.encode()
    )
    assert parameters_json(parameters, "force") == b'{"plates":[]}'
    assert parameters_json(parameters, "3d") is None


def test_the_frame_is_answered_with_the_names_that_outputs_have_given() -> None:
    frame = CoordinateFrame("lab")
    names = {"ros2": {"6d": {"Probe 1": "probe_1"}}}
    answer = frame_answer(frame, names | {"lsl": {}}, {})
    assert json.loads(answer.payload) == json.loads(json.dumps({**frame.facts, "names": names}))
    with raises(QueryError, code="bad-request"):
        frame_answer(frame, names, {"format": "json"})


FIRST = component_message(MARKERS)
SECOND = FIRST[:8] + bytes(8) + FIRST[16:]  # another utime


def test_a_payload_is_made_once_for_all_threads() -> None:
    made: list[int] = []

    def make() -> bytes:
        made.append(1)
        return b"{}"

    payload = JsonPayload(make, 2)
    assert not payload.is_made
    threads = [threading.Thread(target=payload.make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (made, payload.is_made, payload.make()) == ([1], True, b"{}")


def test_the_json_of_a_message_is_made_once() -> None:
    newest = NewestJson()
    _, first = newest.of("3d", FIRST)
    assert json.loads(first.make())["num_markers"] > 0
    assert newest.of("3d", bytes(FIRST))[1] is first
    message, second = newest.of("3d", SECOND)
    assert message == SECOND
    assert json.loads(second.make())["utime"] == 0


def test_while_the_json_of_a_message_waits_to_be_made_later_peers_share_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    newest = NewestJson()
    _, first = newest.of("3d", FIRST)
    assert newest.of("3d", SECOND) == (FIRST, first)
    assert newest.of("6d", SECOND)[0] == SECOND
    monkeypatch.setattr(answers, "_UNMADE_S", 0.0)  # nobody makes it
    assert newest.of("3d", SECOND)[0] == SECOND


def test_a_message_that_is_too_long_is_not_converted() -> None:
    with raises(QueryError, "format=json", code="refused"):
        NewestJson().of("3d", bytes(MAX_JSON_SOURCE_BYTES + 1))


def test_a_file_is_read_when_it_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "a.c3d"
    path.write_bytes(b"content")
    payload = FilePayload(path)
    assert (payload.num_bytes, payload.make()) == (7, b"content")
    path.unlink()
    with raises(QueryError, "a.c3d", code="nothing-yet"):
        payload.make()
