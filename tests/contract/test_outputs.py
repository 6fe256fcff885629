"""What ``gateway.outputs.contract`` promises, for every kind of output, over the real network it sends to."""

import itertools
from collections.abc import Iterator
from typing import Protocol

import lcm
import pytest
import zenoh

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, Publisher
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.outputs.memory import MemoryOutput
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber
from tests.networks import (
    add_multicast_route,
    free_endpoint,
    lcm_url,
    open_zenoh,
    remove_multicast_route,
    zenoh_keys,
)
from tests.waiting import wait_until

MARKERS = Topic("lab", ("3d",), "rtc3d.markers_t")
ANALOG = Topic("lab", ("analog",), "rtc3d.analog_t")
PROBE = Topic("hall-2", ("6d", "Probe 1"), "rtc3d.tool_pose_t")


class Rig(Protocol):
    """An output and the network around it, which is whole at first."""

    @property
    def output(self) -> Output: ...

    @property
    def names(self) -> dict[Topic, str]:
        """What the network calls each topic."""

    @property
    def remedies(self) -> tuple[str, ...]:
        """What ``health`` says to do when the network is cut: one of these."""

    @property
    def received(self) -> list[tuple[str, bytes]]:
        """Names and messages that came out of the network since ``listen``."""

    def listen(self) -> None:
        """Begin to receive all that the output sends."""

    def cut(self) -> None:
        """Make the output unable to send."""

    def mend(self) -> None:
        """Make the network whole again; the output has to find out."""

    def close(self) -> None:
        """Clear the network away."""


class MemoryRig:
    remedies = ("start it",)

    def __init__(self) -> None:
        self.names = {MARKERS: "lab/3d", ANALOG: "lab/analog", PROBE: "hall-2/6d/Probe 1"}
        self.output = MemoryOutput()

    @property
    def received(self) -> list[tuple[str, bytes]]:
        return [("/".join((topic.source, *topic.path)), message) for topic, message in self.output.messages]

    def listen(self) -> None: ...

    def cut(self) -> None:
        self.output.is_open = False

    def mend(self) -> None:
        self.output.is_open = True

    def close(self) -> None: ...


class ZenohRig:
    """A client whose router comes and goes."""

    remedies = ("start zenohd", "is the router running")

    def __init__(self) -> None:
        self.names = {
            MARKERS: "mocap/lab/3d",
            ANALOG: "mocap/lab/analog",
            PROBE: "mocap/hall-2/6d/Probe%201",
        }
        self._endpoint = free_endpoint()
        self._router = open_zenoh("router", listen=self._endpoint)
        self._session: zenoh.Session | None = None
        self.received: list[tuple[str, bytes]] = []
        self.output = ZenohOutput(ZenohSettings(config=zenoh_keys("client", connect=self._endpoint)))

    def listen(self) -> None:
        self._session = open_zenoh("client", connect=self._endpoint)
        self._listener = ZenohSubscriber(self._session, "mocap/**", lambda *each: self.received.append(each))

    def cut(self) -> None:
        self._router.close()

    def mend(self) -> None:
        self._router = open_zenoh("router", listen=self._endpoint)

    def close(self) -> None:
        if self._session is not None:
            self._session.close()
        self._router.close()


class LcmRig:
    """UDP multicast whose route comes and goes."""

    remedies = ("ip route add 224.0.0.0/4",)

    def __init__(self) -> None:
        self.names = {
            MARKERS: "MOCAP_LAB_3D",
            ANALOG: "MOCAP_LAB_ANALOG",
            PROBE: "MOCAP_HALL_2_6D_PROBE_1",
        }
        self._url = lcm_url()
        self._listener: LcmSubscriber | None = None
        self.received: list[tuple[str, bytes]] = []
        self.output = LcmOutput(LcmSettings(url=self._url))

    def listen(self) -> None:
        self._listener = LcmSubscriber(lcm.LCM(self._url), ".*", lambda *each: self.received.append(each))

    def cut(self) -> None:
        remove_multicast_route()

    def mend(self) -> None:
        add_multicast_route()

    def close(self) -> None:
        if self._listener is not None:
            self._listener.close()
        self.mend()


NETWORKED = [
    pytest.param(ZenohRig, id="zenoh"),
    pytest.param(LcmRig, id="lcm", marks=pytest.mark.netns),
]
without_memory = pytest.mark.parametrize("rig", NETWORKED, indirect=True)


@pytest.fixture(params=[pytest.param(MemoryRig, id="memory"), *NETWORKED])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig: Rig = request.param()
    try:
        yield rig
    finally:
        rig.output.close()
        rig.close()


def connected(output: Output) -> bool:
    """Return whether the output can send, after what the gateway does once a second."""
    output.maintain()
    return output.health().connected


def open_output(rig: Rig) -> None:
    rig.output.start()
    wait_until(lambda: connected(rig.output))


def heard_publisher(rig: Rig, topic: Topic) -> Publisher:
    """Return a publisher that the rig hears from its first message on."""
    publisher = rig.output.publisher(topic)
    wait_until(lambda: publisher.wanted)
    return publisher


def refused(publisher: Publisher, message: bytes = b"refused") -> OutputError:
    with pytest.raises(OutputError) as caught:
        publisher.publish(message)
    assert caught.value.cause
    assert str(caught.value)
    return caught.value


def says_what_to_do(rig: Rig) -> bool:
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


def test_messages_arrive_as_they_are_in_order_under_their_own_name(rig: Rig) -> None:
    open_output(rig)
    rig.listen()
    publishers = {topic: heard_publisher(rig, topic) for topic in (MARKERS, ANALOG, PROBE)}
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


def test_a_publisher_made_before_opening_sends_after_it(rig: Rig) -> None:
    early = rig.output.publisher(MARKERS)
    open_output(rig)
    rig.listen()
    late = heard_publisher(rig, ANALOG)
    wait_until(lambda: early.wanted)
    early.publish(b"early")
    late.publish(b"late")
    wait_until(lambda: len(rig.received) >= 2)
    assert sorted(rig.received) == [(rig.names[MARKERS], b"early"), (rig.names[ANALOG], b"late")]


def test_nobody_need_listen(rig: Rig) -> None:
    open_output(rig)
    rig.output.publisher(MARKERS).publish(b"into the void")
    assert rig.output.health().connected


def test_a_closed_publisher_refuses_and_the_others_go_on(rig: Rig) -> None:
    open_output(rig)
    rig.listen()
    closed, other = heard_publisher(rig, MARKERS), heard_publisher(rig, ANALOG)
    closed.close()
    assert refused(closed).cause == "closed"
    other.publish(b"still here")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[ANALOG], b"still here")]


def test_a_topic_given_up_can_be_taken_up_again_under_the_same_name(rig: Rig) -> None:
    open_output(rig)
    rig.listen()
    first = heard_publisher(rig, PROBE)
    first.close()
    second = heard_publisher(rig, PROBE)
    first.close()
    assert refused(first).cause == "closed"
    second.publish(b"again")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[PROBE], b"again")]


# Life cycle ----------------------------------------------------------------------------------


def test_before_opening_messages_are_refused_and_health_says_why(rig: Rig) -> None:
    publisher = rig.output.publisher(MARKERS)
    health = rig.output.health()
    assert not health.connected
    error = refused(publisher)
    assert (error.cause, str(error)) == ("not open", health.problem)


def test_an_open_output_is_healthy(rig: Rig) -> None:
    open_output(rig)
    assert rig.output.health().problem == ""


def test_after_closing_messages_are_refused_and_health_says_why(rig: Rig) -> None:
    open_output(rig)
    publisher = rig.output.publisher(MARKERS)
    rig.output.close()
    health = rig.output.health()
    error = refused(publisher)
    assert (health.connected, error.cause, str(error)) == (False, "not open", health.problem)
    assert refused(rig.output.publisher(ANALOG)).cause == "not open"


def test_closing_is_safe_from_any_state(rig: Rig) -> None:
    rig.output.close()
    rig.output.close()
    assert not rig.output.health().connected


def test_closing_again_is_safe_for_output_and_publisher(rig: Rig) -> None:
    open_output(rig)
    publisher = rig.output.publisher(MARKERS)
    rig.output.close()
    rig.output.close()
    publisher.close()
    publisher.close()
    assert refused(publisher).cause == "closed"


def test_a_closed_output_stays_closed(rig: Rig) -> None:
    open_output(rig)
    rig.output.close()
    rig.output.maintain()
    rig.output.announce("lab")
    assert not rig.output.health().connected


def test_sources_can_be_shown_in_any_state(rig: Rig) -> None:
    def show() -> None:
        rig.output.announce("lab")
        for flowing in (True, True, False, False, True):
            rig.output.show_streaming("lab", flowing)
        rig.output.withdraw("lab")

    show()
    open_output(rig)
    show()
    assert connected(rig.output)
    rig.output.close()
    show()


# Healing -------------------------------------------------------------------------------------


@without_memory
def test_without_a_network_starting_raises_nothing_and_health_says_what_to_do(rig: Rig) -> None:
    rig.cut()
    rig.output.start()
    refused(rig.output.publisher(MARKERS))
    assert says_what_to_do(rig)


@without_memory
def test_an_output_started_without_a_network_sends_once_there_is_one(rig: Rig) -> None:
    rig.cut()
    rig.output.start()
    publisher = rig.output.publisher(MARKERS)
    rig.mend()
    wait_until(lambda: connected(rig.output))
    rig.listen()
    wait_until(lambda: publisher.wanted)
    publisher.publish(b"at last")
    wait_until(lambda: rig.received)
    assert rig.received == [(rig.names[MARKERS], b"at last")]


def test_a_network_lost_is_told_and_messages_go_out_again_once_it_is_back(rig: Rig) -> None:
    open_output(rig)
    rig.listen()
    sending = Sending(heard_publisher(rig, MARKERS))
    assert not sending.is_refused()
    rig.cut()
    wait_until(sending.is_refused)
    assert says_what_to_do(rig)

    rig.mend()
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


@without_memory
def test_closing_is_safe_without_a_network(rig: Rig) -> None:
    rig.cut()
    rig.output.start()
    publisher = rig.output.publisher(MARKERS)
    rig.output.close()
    assert not rig.output.health().connected
    assert refused(publisher).cause == "not open"
