"""The output in memory, which tests and benchmarks read, and the JSON of answers."""

import pytest

from gateway.errors import OutputError
from gateway.messages.decode import json_bytes
from gateway.messages.topics import Topic
from gateway.outputs.contract import OutputHealth
from gateway.outputs.memory import MemoryOutput

TOPIC = Topic("lab", ("3d",), "rtc3d.markers_t")


def test_it_is_healthy_while_open_and_stores_the_newest_messages_with_their_topics() -> None:
    assert MemoryOutput().messages.maxlen == 100_000
    output = MemoryOutput(capacity=2)
    closed = OutputHealth(False, "memory output is not open; start it")
    assert output.health() == closed
    output.start()
    assert output.health() == OutputHealth(True, "")
    for message in (b"1", b"2", b"3"):
        output.publisher(TOPIC).publish(message)
    assert list(output.messages) == [(TOPIC, b"2"), (TOPIC, b"3")]
    output.close()
    assert output.health() == closed


def test_it_shows_the_sources_that_are_announced_and_that_stream() -> None:
    output = MemoryOutput()
    for source in ("lab", "hall"):
        output.announce(source)
        output.show_streaming(source, True)
    assert (output.announced, output.streaming) == ({"lab", "hall"}, {"lab", "hall"})
    output.show_streaming("hall", False)
    output.withdraw("lab")
    assert (output.announced, output.streaming) == ({"hall"}, {"lab"})


def test_a_closed_publisher_and_a_closed_output_raise() -> None:
    output = MemoryOutput()
    publisher = output.publisher(TOPIC)
    with pytest.raises(OutputError) as not_open:
        publisher.publish(b"message")
    output.start()
    publisher.close()
    with pytest.raises(OutputError) as closed:
        publisher.publish(b"message")
    assert (str(not_open.value), not_open.value.cause) == ("memory output is not open; start it", "not open")
    assert (str(closed.value), closed.value.cause) == (
        f"{TOPIC} is closed; ask for a new publisher",
        "closed",
    )
    assert not output.messages


def test_a_test_decides_whether_there_is_a_subscriber() -> None:
    output = MemoryOutput()
    publisher = output.publisher(TOPIC)
    wanted = [publisher.wanted]
    output.has_subscriber = False
    assert [*wanted, publisher.wanted] == [True, False]


def test_json_is_compact_and_in_utf8() -> None:
    assert json_bytes({"name": "Käfig", "values": [1, 2.5, None]}) == (
        '{"name":"Käfig","values":[1,2.5,null]}'.encode()
    )


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_json_does_not_have_are_errors(value: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_bytes([value])
