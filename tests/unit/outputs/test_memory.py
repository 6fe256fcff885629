"""The output in memory: what tests and benchmarks read from it."""

import pytest

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.memory import MemoryOutput
from gateway.outputs.status import OutputHealth

TOPIC = Topic("lab", ("3d",), "rtc3d.markers_t")


def test_it_stores_the_newest_messages_with_their_topics() -> None:
    output = MemoryOutput(capacity=2)
    output.start()
    for message in (b"1", b"2", b"3"):
        output.publisher(TOPIC).publish(message)
    assert list(output.messages) == [(TOPIC, b"2"), (TOPIC, b"3")]


def test_it_stores_100000_messages_by_default() -> None:
    assert MemoryOutput().messages.maxlen == 100_000


def test_it_shows_the_sources_that_are_announced_and_that_stream() -> None:
    output = MemoryOutput()
    for source in ("lab", "hall"):
        output.announce(source)
        output.show_streaming(source, True)
    assert (output.announced, output.streaming) == ({"lab", "hall"}, {"lab", "hall"})
    output.show_streaming("hall", False)
    output.withdraw("lab")
    assert (output.announced, output.streaming) == ({"hall"}, {"lab"})


def test_it_is_healthy_from_start_to_close() -> None:
    output = MemoryOutput()
    states = [output.health()]
    output.start()
    states.append(output.health())
    output.close()
    states.append(output.health())
    closed = OutputHealth(False, "memory output is not open; start it")
    assert states == [closed, OutputHealth(True, ""), closed]


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
