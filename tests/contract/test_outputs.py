"""What ``gateway.outputs.contract`` promises, for every kind of output, over the real network it sends to."""

import itertools
from collections.abc import Iterator

import pytest

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, Publisher
from tests.contract.rigs import (
    ANALOG,
    MARKERS,
    PROBE,
    LcmRelayRig,
    LcmRig,
    Rig,
    TakesRig,
    ZenohRig,
)
from tests.support.waiting import wait_until

RIGS = [
    pytest.param(ZenohRig, id="zenoh"),
    pytest.param(LcmRig, id="lcm-multicast", marks=pytest.mark.netns),
    pytest.param(LcmRelayRig, id="lcm-relay"),
    pytest.param(TakesRig, id="takes"),
]


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig: Rig = request.param()
    try:
        yield rig
    finally:
        rig.output.close()
        rig.close()


def can_send(output: Output) -> bool:
    """Call ``maintain``, as the gateway does once a second; return whether the output can send."""
    output.maintain()
    return output.health().connected


def open_output(rig: Rig) -> None:
    rig.output.start()
    wait_until(lambda: can_send(rig.output))


def subscribed_publisher(rig: Rig, topic: Topic) -> Publisher:
    """Return a publisher whose first message already reaches the rig's subscriber."""
    publisher = rig.output.publisher(topic)
    wait_until(lambda: publisher.wanted)
    return publisher


def refused(publisher: Publisher, message: bytes = b"refused") -> OutputError:
    with pytest.raises(OutputError) as caught:
        publisher.publish(message)
    assert caught.value.cause
    assert str(caught.value)
    return caught.value


def health_names_remedy(rig: Rig) -> bool:
    health = rig.output.health()
    return not health.connected and any(remedy in health.problem for remedy in rig.remedies)


class Sending:
    """Sends numbered messages, one at each call."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._messages = (b"message %d" % number for number in itertools.count())
        self.refused: list[bytes] = []
        self.accepted: list[bytes] = []

    def is_refused(self) -> bool:
        message = next(self._messages)
        try:
            self._publisher.publish(message)
        except OutputError:
            self.refused.append(message)
            return True
        self.accepted.append(message)
        return False


# Sending -------------------------------------------------------------------------------------


def test_messages_arrive_unchanged_and_in_order_under_their_own_name(rig: Rig) -> None:
    open_output(rig)
    rig.subscribe()
    publishers = {topic: subscribed_publisher(rig, topic) for topic in (MARKERS, ANALOG, PROBE)}
    sent: dict[str, list[bytes]] = {rig.names[topic]: [] for topic in publishers}
    for number in range(20):
        for topic, publisher in publishers.items():
            message = bytes([number, *topic.path[0].encode()]) * (number * 20)  # 0 to 2.6 kB
            publisher.publish(message)
            sent[rig.names[topic]].append(message)
    wait_until(lambda: len(rig.received) >= 60)
    arrived = {name: [message for each, message in rig.received if each == name] for name in sent}
    assert arrived == sent
    assert len(rig.received) == 60


def test_a_publisher_created_before_opening_refuses_messages_and_sends_afterwards(rig: Rig) -> None:
    early = rig.output.publisher(MARKERS)
    health = rig.output.health()
    error = refused(early)
    assert (health.connected, error.cause, str(error)) == (False, "not open", health.problem)
    open_output(rig)
    assert rig.output.health().problem == ""
    rig.subscribe()
    late = subscribed_publisher(rig, ANALOG)
    wait_until(lambda: early.wanted)
    early.publish(b"early")
    late.publish(b"late")
    wait_until(lambda: len(rig.received) >= 2)
    assert sorted(rig.received) == [(rig.names[MARKERS], b"early"), (rig.names[ANALOG], b"late")]


def test_a_closed_publisher_refuses_messages_and_the_others_still_send(rig: Rig) -> None:
    open_output(rig)
    rig.subscribe()
    closed, other = subscribed_publisher(rig, MARKERS), subscribed_publisher(rig, ANALOG)
    closed.close()
    assert refused(closed).cause == "closed"
    other.publish(b"still here")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[ANALOG], b"still here")]


def test_a_new_publisher_gets_the_name_of_a_closed_one(rig: Rig) -> None:
    open_output(rig)
    rig.subscribe()
    first = subscribed_publisher(rig, PROBE)
    first.close()
    second = subscribed_publisher(rig, PROBE)
    first.close()
    assert refused(first).cause == "closed"
    second.publish(b"again")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[PROBE], b"again")]


# Life cycle ----------------------------------------------------------------------------------


def test_after_closing_for_good_messages_are_refused_and_health_has_the_reason(rig: Rig) -> None:
    open_output(rig)
    publisher = rig.output.publisher(MARKERS)
    publisher.publish(b"to nobody")
    for _ in range(2):
        rig.output.close()
    rig.output.maintain()
    rig.output.announce("lab")
    health = rig.output.health()
    error = refused(publisher)
    assert (health.connected, error.cause, str(error)) == (False, "not open", health.problem)
    assert refused(rig.output.publisher(ANALOG)).cause == "not open"
    for _ in range(2):
        publisher.close()
    assert refused(publisher).cause == "closed"


def test_an_output_that_was_never_started_can_be_closed_twice(rig: Rig) -> None:
    rig.output.close()
    rig.output.close()
    assert not rig.output.health().connected


def test_sources_can_be_announced_and_withdrawn_in_any_state(rig: Rig) -> None:
    def show() -> None:
        rig.output.announce("lab")
        for is_streaming in (True, True, False, False, True):
            rig.output.show_streaming("lab", is_streaming)
        rig.output.withdraw("lab")

    show()
    open_output(rig)
    show()
    assert can_send(rig.output)
    rig.output.close()
    show()


# Reconnecting -------------------------------------------------------------------------------------


def test_an_output_started_without_a_network_sends_once_the_network_works(rig: Rig) -> None:
    rig.cut()
    rig.output.start()
    publisher = rig.output.publisher(MARKERS)
    refused(publisher)
    assert health_names_remedy(rig)
    rig.restore()
    wait_until(lambda: can_send(rig.output))
    rig.subscribe()
    wait_until(lambda: publisher.wanted)
    publisher.publish(b"the first")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[MARKERS], b"the first")]


def test_a_lost_network_is_reported_and_messages_leave_again_once_it_is_back(rig: Rig) -> None:
    open_output(rig)
    rig.subscribe()
    sending = Sending(subscribed_publisher(rig, MARKERS))
    assert not sending.is_refused()
    rig.cut()
    wait_until(sending.is_refused)
    assert health_names_remedy(rig)

    rig.restore()
    before = len(sending.accepted)

    def arrives() -> bool:
        rig.output.maintain()
        sending.is_refused()
        return any(message in sending.accepted[before:] for _, message in rig.received)

    wait_until(arrives)
    assert rig.output.health().connected
    assert not sending.is_refused()
    wait_until(lambda: rig.received[-1][1] == sending.accepted[-1])
    assert not {message for _, message in rig.received} & set(sending.refused)


def test_closing_is_safe_without_a_network(rig: Rig) -> None:
    rig.cut()
    rig.output.start()
    rig.output.close()
    assert not rig.output.health().connected
