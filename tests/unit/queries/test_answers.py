import json

import pytest
import rtc3d

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import encode_message
from gateway.messages.stamp import Stamp
from gateway.outputs.encodings import TEXT
from gateway.queries.answers import message_answer, parameters_json, schema_answer
from gateway.queries.frame_answer import frame_answer
from gateway.queries.payloads import NewestJson
from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import General, Parameters, ParametersForce
from tests.vectors import FULL_FRAME


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
    with pytest.raises(QueryError, match="frame takes no options"):
        frame_answer(frame, names, {"format": "json"})
