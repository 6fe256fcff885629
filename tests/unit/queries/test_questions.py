import pytest

from gateway.errors import QueryError
from gateway.messages.history import WantedMessages
from gateway.messages.host_time import now_utime
from gateway.queries.questions import Question, accepted_keys, known_keys, parse_question, parse_questions
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from tests.support.errors import raises

ALL = frozenset(WIRE_ORDER)
MARKERS_ONLY = frozenset({ComponentType.MARKERS})


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
        ("recording", {"set": "start", "name": "walk 1"}, Question("recording", "walk 1", set="start")),
        (
            *("recording", {"set": "start", "options": ",duration=5"}),
            Question("recording", set="start", options=",duration=5"),
        ),
        ("recording", {}, Question("recording")),
        ("history", {}, Question("history")),
        ("3d", {"from": "7"}, Question("messages", "3d", wanted=WantedMessages(7))),
        ("clock", {"from": "0", "to": "9"}, Question("messages", "clock", wanted=WantedMessages(0, None, 9))),
        ("3d", {"from": "0&to=9"}, Question("messages", "3d", wanted=WantedMessages(0, None, 9))),
        (
            *("status", {"since_utime": "12", "to": "3"}),
            Question("messages", "status", wanted=WantedMessages(None, 12, 3)),
        ),
        ("6d/Tool%201", {"from": "1"}, Question("messages", "6d/Tool 1", wanted=WantedMessages(1))),
    ],
)
def test_a_key_and_its_options_are_parsed(key: str, options: dict[str, str], question: Question) -> None:
    assert parse_question(tuple(key.split("/")), options, ALL) == question


@pytest.mark.parametrize(
    "key", ["", "4d", "events", "parameters/", "parameters/event", "3d/1", "schema/../x"]
)
def test_an_unknown_key_is_refused(key: str) -> None:
    with pytest.raises(QueryError, match="accepted: ") as refused:
        parse_question(tuple(key.split("/")), {}, ALL)
    assert refused.value.code == "bad-request"


@pytest.mark.parametrize(
    ("options", "value"),
    [
        ({"set": "stop", "name": "walk"}, "name"),
        ({"set": "stop", "options": "duration=5"}, "options"),
        ({"name": "walk"}, "name"),
        ({"set": "start", "name": ""}, "''"),
        ({"set": "start", "name": "../x"}, "../x"),
        ({"set": "start", "name": "x,run=1"}, "x,run=1"),
        ({"set": "start", "name": "x\0"}, "x\\x00"),
        ({"set": "start", "name": "x" * 1_000_000}, 100),
    ],
)
def test_the_name_of_a_recording_is_checked(options: dict[str, str], value: object) -> None:
    with raises(QueryError, value, code="bad-request") as refused:
        parse_question(("recording",), options, ALL)
    assert len(str(refused.value)) < 400


def test_the_last_seconds_count_from_now() -> None:
    before = now_utime()
    wanted = parse_question(("3d",), {"last_s": "2.5"}, ALL).wanted
    assert wanted is not None
    assert wanted.since_utime is not None
    assert wanted.last_s == 2.5
    assert before - 2_500_000 <= wanted.since_utime <= now_utime() - 2_500_000
    assert parse_question(("3d",), {"last_s": "1e12"}, ALL).wanted == WantedMessages(None, 0, None, 1e12)


@pytest.mark.parametrize(
    ("key", "options"),
    [
        ("3d", {"to": "5"}),
        ("3d", {"from": "5", "last_s": "1"}),
        ("3d", {"from": "-1"}),
        ("3d", {"from": "1.5"}),
        ("3d", {"from": "²"}),
        ("3d", {"from": "9" * 19}),
        ("3d", {"from": "1", "to": ""}),
        ("3d", {"last_s": "nan"}),
        ("3d", {"last_s": "inf"}),
        ("3d", {"last_s": "-1"}),
        ("3d", {"from": "1", "format": "json"}),
        ("6d/Tool", {}),
        ("parameters", {"from": "1"}),
        ("history", {"from": "1"}),
    ],
)
def test_a_query_for_messages_with_other_options_is_refused(key: str, options: dict[str, str]) -> None:
    with pytest.raises(QueryError) as refused:
        parse_question(tuple(key.split("/")), options, ALL)
    assert refused.value.code == "bad-request"


def test_every_known_key_is_parsed_and_listed_as_accepted() -> None:
    for components in (ALL, MARKERS_ONLY):
        keys = known_keys(components)
        assert len(set(keys)) == len(keys)
        for path in keys:
            parse_question(path, {}, components)
            text = "schema/TYPE" if path[0] == "schema" else "/".join(path)
            assert text in accepted_keys(components).split(", ")
    assert ("6d",) not in known_keys(MARKERS_ONLY)


def test_error_messages_quote_a_bounded_part_of_the_query() -> None:
    for options in ({"x" * 1000: ""}, {"format": "x" * 1000}):
        with pytest.raises(QueryError) as refused:
            parse_question(("parameters",), options, ALL)
        assert len(str(refused.value)) < 250
    with pytest.raises(QueryError) as refused:
        parse_question(("parameters", "\x1b[31m" + "x" * 1000), {}, ALL)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 250


def test_each_key_of_a_wildcard_gets_the_options_that_it_accepts() -> None:
    keys = [("parameters",), ("3d",), ("status",)]
    assert parse_questions(keys, {"format": "xml", "fresh": "true"}, ALL) == {
        ("parameters",): Question("parameters", fresh=True),
        ("3d",): Question("component", "3d"),
        ("status",): Question("status"),
    }
    with_json = parse_questions(keys, {"format": "json"}, ALL)
    assert all(question.as_json for question in with_json.values())


@pytest.mark.parametrize("options", [{"set": "start"}, {"format": "yaml"}, {"fresh": "maybe"}])
def test_an_option_that_no_key_of_a_wildcard_accepts_is_refused(options: dict[str, str]) -> None:
    with pytest.raises(QueryError, match="accepted: "):
        parse_questions([("parameters",), ("3d",)], options, ALL)
