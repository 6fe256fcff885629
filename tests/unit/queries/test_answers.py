import json
import math

import pytest
import rtc3d

from gateway.errors import QueryError
from gateway.messages.splice import splice
from gateway.messages.stamp import Stamp
from gateway.outputs.encodings import JSON, TEXT
from gateway.queries.answers import message_answer, parameters_json, schema_answer
from gateway.queries.questions import (
    SCHEMA_TYPES,
    Question,
    accepted_keys,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import General, Parameters, ParametersForce, Plate, Point
from tests.vectors import FULL_FRAME

ALL = frozenset(WIRE_ORDER)
MARKERS_ONLY = frozenset({ComponentType.MARKERS})


def message_of(kind: ComponentType) -> bytes:
    components = split_frame(FULL_FRAME["big"], "big").components
    [component] = [each for each in components if each.type is kind]
    return splice(component, Stamp(1, 2, 3), 4)


@pytest.mark.parametrize(
    ("key", "options", "question"),
    [
        ("parameters", {}, Question("parameters")),
        ("parameters/6d", {}, Question("parameters", "6d")),
        ("parameters", {"format": "json"}, Question("parameters", as_json=True)),
        ("parameters", {"format": "xml", "fresh": "true"}, Question("parameters", fresh=True)),
        ("parameters", {"fresh": "false", "stale": "ok"}, Question("parameters", stale_ok=True)),
        ("3d", {}, Question("component", "3d")),
        ("event", {"format": "json"}, Question("component", "event", as_json=True)),
        ("6d", {"format": "lcm"}, Question("component", "6d")),
        ("status", {"format": "json"}, Question("status", as_json=True)),
        ("c3d", {}, Question("c3d")),
        ("schema/markers_t", {}, Question("schema", "markers_t")),
        ("schema/rtc3d.marker_t", {}, Question("schema", "marker_t")),
        ("recording", {"set": "start"}, Question("recording", set="start")),
        ("recording", {}, Question("recording")),
    ],
)
def test_a_key_and_its_options_make_a_question(key: str, options: dict[str, str], question: Question) -> None:
    assert parse_question(tuple(key.split("/")), options, ALL) == question


@pytest.mark.parametrize(
    "key", ["", "4d", "events", "parameters/", "parameters/event", "3d/1", "schema/../x"]
)
def test_an_unknown_key_is_refused(key: str) -> None:
    with pytest.raises(QueryError, match="accepted: ") as refused:
        parse_question(tuple(key.split("/")), {}, ALL)
    assert refused.value.code == "bad-request"


def test_every_known_key_is_a_question_and_is_told_as_accepted() -> None:
    for components in (ALL, MARKERS_ONLY):
        keys = known_keys(components)
        assert len(set(keys)) == len(keys)
        for parts in keys:
            parse_question(parts, {}, components)
            told = "schema/TYPE" if parts[0] == "schema" else "/".join(parts)
            assert told in accepted_keys(components).split(", ")
    assert ("6d",) not in known_keys(MARKERS_ONLY)


def test_the_words_of_an_asker_are_bounded_in_the_error() -> None:
    for options in ({"x" * 1000: ""}, {"format": "x" * 1000}):
        with pytest.raises(QueryError) as refused:
            parse_question(("parameters",), options, ALL)
        assert len(str(refused.value)) < 250
    with pytest.raises(QueryError) as refused:
        parse_question(("parameters", "\x1b[31m" + "x" * 1000), {}, ALL)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 250


def test_each_key_of_a_wildcard_takes_the_options_that_mean_something_to_it() -> None:
    keys = [("parameters",), ("3d",), ("status",)]
    assert parse_questions(keys, {"format": "xml", "fresh": "true"}, ALL) == {
        ("parameters",): Question("parameters", fresh=True),
        ("3d",): Question("component", "3d"),
        ("status",): Question("status"),
    }
    with_json = parse_questions(keys, {"format": "json"}, ALL)
    assert all(question.as_json for question in with_json.values())


@pytest.mark.parametrize("options", [{"set": "start"}, {"format": "yaml"}, {"fresh": "maybe"}])
def test_an_option_that_means_nothing_to_any_key_of_a_wildcard_is_refused(options: dict[str, str]) -> None:
    with pytest.raises(QueryError, match="accepted: "):
        parse_questions([("parameters",), ("3d",)], options, ALL)


@pytest.mark.parametrize("name", SCHEMA_TYPES)
def test_a_schema_holds_the_type_and_all_that_it_consists_of_before_it(name: str) -> None:
    answer = schema_answer(name)
    text = answer.payload.decode()
    assert answer.encoding == TEXT
    types = [line.split()[1] for line in text.splitlines() if line.startswith("struct ")]
    assert types[-1] == name
    assert len(set(types)) == len(types)
    used = {part.removeprefix("rtc3d.") for part in getattr(rtc3d, name).__typenames__ if "." in part}
    assert used <= set(types)


def test_nested_types_are_in_a_schema_too() -> None:
    text = schema_answer("status_t").payload.decode()
    order = [text.index(f"struct {name} ") for name in ("clock_model_t", "stream_status_t", "status_t")]
    assert order == sorted(order)


def test_a_message_comes_as_it_is_with_its_type() -> None:
    message = message_of(ComponentType.FORCE)
    answer = message_answer(message, Question("component", "force"), {"session": 3})
    assert answer.payload is message
    assert answer.encoding == "application/x-lcm;rtc3d.forces_t"
    assert answer.attachment == {"session": 3}


def test_a_message_as_json_has_null_for_what_is_missing() -> None:
    answer = message_answer(message_of(ComponentType.MARKERS), Question("component", "3d", as_json=True), {})
    value = json.loads(answer.payload)
    assert answer.encoding == JSON
    assert (value["sequence"], value["session"], value["utime"]) == (4, 3, 1)
    missing = [marker for marker in value["markers"] if marker["x"] is None]
    assert missing
    assert {(marker["y"], marker["z"]) for marker in missing} == {(None, None)}


def test_parameters_as_json_have_the_sections_that_are_there() -> None:
    parameters = Parameters(general=General(name="Höhe"), force=ParametersForce())
    assert parameters_json(parameters, "") == (
        '{"general":{"name":"Höhe","version":"","address":"","port":null,"frames_sent":null,'
        '"frames_per_s":null},"force":{"plates":[]}}'.encode()
    )
    assert parameters_json(parameters, "force") == b'{"plates":[]}'
    assert parameters_json(parameters, "3d") is None


def test_numbers_that_a_plate_lacks_are_null_in_json() -> None:
    plate = Plate("1", corners=(Point(x=1.0),), calibration_matrix=((2.0, math.nan),))
    written = parameters_json(Parameters(force=ParametersForce((plate,))), "force")
    assert written is not None
    [value] = json.loads(written)["plates"]
    assert value["corners"] == [{"x": 1.0, "y": None, "z": None, "unit": "mm"}]
    assert value["calibration_matrix"] == [[2.0, None]]
