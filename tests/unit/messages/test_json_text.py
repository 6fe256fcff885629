import json
import math

import pytest

from gateway.messages.decode import decode, to_json
from gateway.messages.json_text import json_text
from gateway.rtc3d.parameters import Parameters, ParametersForce, Plate, Point
from tests.unit.messages.samples import component_message, status_of, tool_pose_messages
from tests.vectors import COMPONENTS


@pytest.mark.parametrize("message", [*map(component_message, COMPONENTS), *tool_pose_messages(), status_of()])
def test_the_text_of_a_message_is_that_of_the_json_module(message: bytes) -> None:
    value = decode(message)
    assert json_text(value) == json.dumps(to_json(value), separators=(",", ":"), ensure_ascii=False)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([math.inf, -math.inf, math.nan, -0.0, 1e300, 0.1], "[null,null,null,-0.0,1e+300,0.1]"),
        ({"Käfig": (1, True, False, None)}, '{"Käfig":[1,true,false,null]}'),
        ('"\\\n\x00\u2028', '"\\"\\\\\\n\\u0000\u2028"'),
        ([], "[]"),
        ({}, "{}"),
    ],
)
def test_values(value: object, text: str) -> None:
    assert json_text(value) == text


def test_parameters_are_objects_of_their_fields() -> None:
    plate = Plate("1", corners=(Point(x=1.0),))
    written = json_text(Parameters(force=ParametersForce((plate,))))
    assert json.loads(written) == json.loads(
        json.dumps(to_json(Parameters(force=ParametersForce((plate,)))), allow_nan=False)
    )
