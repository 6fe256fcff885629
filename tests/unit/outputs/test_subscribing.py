"""Subscribing to an output as ``echo`` and the demo do: what is selected, and that messages arrive."""

import threading
from collections.abc import Iterator

import lcm
import pytest
import rtc3d

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output
from gateway.outputs.kind import DemoSide, Subscription, SubscriptionRequest
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LCM, LcmSettings
from gateway.outputs.lcm.subscriber import channel_pattern
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZENOH, ZenohSettings
from gateway.outputs.zenoh.subscriber import key_patterns
from tests.support.errors import raises
from tests.support.memory_output import MemoryOutput
from tests.support.networks import (
    add_multicast_route,
    free_endpoint,
    lcm_url,
    remove_multicast_route,
    zenoh_keys,
)
from tests.support.waiting import wait_until

MARKERS = Topic("lab", ("3d",), "rtc3d.markers_t")
ELSEWHERE = Topic("hall", ("3d",), "rtc3d.markers_t")
NAMES = {"zenoh": "mocap/lab/3d", "lcm": "MOCAP_LAB_3D"}


@pytest.fixture
def received() -> list[tuple[str, bytes]]:
    return []


def send_until_received(output: Output, received: list[tuple[str, bytes]]) -> None:
    """Publish until a message arrives: on a network, the subscription takes effect some time later."""
    publishers = [output.publisher(topic) for topic in (ELSEWHERE, MARKERS)]

    def arrived() -> bool:
        for publisher in publishers:
            publisher.publish(b"message")
        return bool(received)

    wait_until(lambda: output.health().connected)
    wait_until(arrived)


@pytest.fixture(params=sorted(name for name, kind in OUTPUTS.items() if kind.demo is not None))
def demo(request: pytest.FixtureRequest) -> Iterator[tuple[str, DemoSide]]:
    build = OUTPUTS[request.param].demo
    assert build is not None
    side = build(False)
    side.output.start()
    yield request.param, side
    side.output.close()


def test_the_demo_receives_the_messages_of_its_source_only(
    demo: tuple[str, DemoSide], received: list[tuple[str, bytes]]
) -> None:
    name, side = demo
    wait_until(lambda: side.output.health().connected)
    subscription = side.subscribe("lab", lambda *each: received.append(each))
    send_until_received(side.output, received)
    subscription.close()
    assert set(received) == {(NAMES[name], b"message")}


def test_the_demo_uses_zenoh_without_scouting_and_lcm_in_memory() -> None:
    assert ZENOH.demo is not None
    assert LCM.demo is not None
    zenoh_settings, lcm_settings = ZENOH.demo(False).settings, LCM.demo(False).settings
    assert isinstance(zenoh_settings, ZenohSettings)
    assert isinstance(lcm_settings, LcmSettings)
    assert isinstance(zenoh_settings.config, dict)
    assert zenoh_settings.config["scouting"] == {"multicast": {"enabled": False}}
    [endpoint] = zenoh_settings.config["listen"]["endpoints"]
    assert endpoint.startswith("tcp/127.0.0.1:")
    assert lcm_settings.url == "memq://"


@pytest.mark.netns
def test_the_demo_on_the_network_uses_the_default_of_lcm(received: list[tuple[str, bytes]]) -> None:
    assert LCM.demo is not None
    side = LCM.demo(True)
    assert isinstance(side.settings, LcmSettings)
    assert side.settings.url is None
    side.output.start()
    subscription = side.subscribe("lab", lambda *each: received.append(each))
    send_until_received(side.output, received)
    subscription.close()
    side.output.close()
    assert set(received) == {(NAMES["lcm"], b"message")}


@pytest.mark.netns
def test_the_demo_in_memory_needs_no_network(received: list[tuple[str, bytes]]) -> None:
    assert LCM.demo is not None
    remove_multicast_route()
    try:
        side = LCM.demo(False)
        side.output.start()
        subscription = side.subscribe("lab", lambda *each: received.append(each))
        send_until_received(side.output, received)
        subscription.close()
    finally:
        add_multicast_route()
    assert set(received) == {(NAMES["lcm"], b"message")}


def subscribed(kind: str, request: SubscriptionRequest, received: list[tuple[str, bytes]]) -> Subscription:
    subscribe = OUTPUTS[kind].subscribe
    assert subscribe is not None
    return subscribe(request, lambda *each: received.append(each))


def test_zenoh_is_subscribed_to_at_an_endpoint(received: list[tuple[str, bytes]]) -> None:
    endpoint = free_endpoint()
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer", listen=endpoint)))
    output.start()
    wait_until(lambda: output.health().connected)
    subscription = subscribed("zenoh", SubscriptionRequest("lab", "3d", address=endpoint), received)
    send_until_received(output, received)
    subscription.close()
    output.close()
    assert set(received) == {("mocap/lab/3d", b"message")}


@pytest.mark.netns
def test_lcm_is_subscribed_to_at_a_url(received: list[tuple[str, bytes]]) -> None:
    url = lcm_url()
    output = LcmOutput(LcmSettings(url=url, prefix="HALL"))
    output.start()
    subscription = subscribed("lcm", SubscriptionRequest(prefix="HALL", source="lab", address=url), received)
    send_until_received(output, received)
    subscription.close()
    output.close()
    assert set(received) == {("HALL_LAB_3D", b"message")}


@pytest.mark.netns
def test_no_message_is_lost_while_a_receiver_of_lcm_pauses() -> None:
    url, received, may_continue = lcm_url(), [], threading.Event()

    def receive(_channel: str, message: bytes) -> None:
        received.append(message)
        may_continue.wait(10)

    subscribe = OUTPUTS["lcm"].subscribe
    assert subscribe is not None
    subscription = subscribe(SubscriptionRequest("lab", address=url), receive)
    publisher = lcm.LCM(url)
    sent = [b"%d" % number for number in range(100)]  # LCM's own queue has 30 places
    for message in sent:
        publisher.publish("MOCAP_LAB_3D", message)
    wait_until(lambda: received)
    may_continue.set()
    wait_until(lambda: len(received) == len(sent))
    subscription.close()
    assert received == sent


@pytest.mark.netns
def test_how_gateways_show_themselves_on_lcm_is_no_message(received: list[tuple[str, bytes]]) -> None:
    """The URL of requests may be that of the messages. A tool may have the name of that channel."""
    url = lcm_url()
    subscription = subscribed("lcm", SubscriptionRequest(address=url), received)
    publisher = lcm.LCM(url)
    publisher.publish("MOCAP_LAB_GATEWAY", rtc3d.command_request_t().encode())
    shown = [("MOCAP_LAB_6D_GATEWAY", rtc3d.tool_pose_t().encode()), ("MOCAP_LAB_3D", b"message")]
    for channel, message in shown:
        publisher.publish(channel, message)
    wait_until(lambda: len(received) >= len(shown))
    subscription.close()
    assert received == shown


def test_an_endpoint_without_zenoh_is_named_with_what_to_check(received: list[tuple[str, bytes]]) -> None:
    endpoint = free_endpoint()
    with raises(OutputError, endpoint, "gateway", "router", cause="not open"):
        subscribed("zenoh", SubscriptionRequest(address=endpoint), received)


@pytest.mark.parametrize(
    ("source", "component", "keys", "channels"),
    [
        (None, None, "mocap/*/* mocap/*/6d/*", "MOCAP_.+"),
        ("lab", None, "mocap/lab/* mocap/lab/6d/*", "MOCAP_LAB_.+"),
        (None, "3d", "mocap/*/3d", "MOCAP_.+_3D"),
        ("lab", "3d", "mocap/lab/3d", "MOCAP_LAB_3D"),
        ("lab", "6d/Left hand", "mocap/lab/6d/Left%20hand", "MOCAP_LAB_6D_LEFT_HAND"),
        (None, "6d/a/b*", "mocap/*/6d/a%2Fb%2A", "MOCAP_.+_6D_A_B"),
        ("lab", "6d/*", "mocap/lab/6d/*", "MOCAP_LAB_6D_.+"),
        (None, "6d/*", "mocap/*/6d/*", "MOCAP_.+_6D_.+"),
    ],
)
def test_no_source_and_no_component_select_all_of_them(
    source: str | None, component: str | None, keys: str, channels: str
) -> None:
    assert " ".join(key_patterns("mocap", source, component)) == keys
    assert channel_pattern("MOCAP", source, component) == channels


def test_characters_of_regular_expressions_in_a_prefix_are_taken_as_they_are() -> None:
    assert channel_pattern("A.B", None, None) == r"A\.B_.+"
    assert channel_pattern("A.B", "lab", None) == r"A\.B_LAB_.+"
    assert channel_pattern("A.B", "lab", "3d") == r"A\.B_LAB_3D"
    assert channel_pattern("A.B", None, "6d/x.y") == r"A\.B_.+_6D_X_Y"


@pytest.mark.parametrize(
    ("outputs", "are_alike"),
    [
        ((LcmOutput(LcmSettings(prefix="A")), LcmOutput(LcmSettings(prefix="A"))), True),
        ((LcmOutput(LcmSettings(prefix="A")), LcmOutput(LcmSettings(prefix="B"))), False),
        ((LcmOutput(LcmSettings(tool_poses=True)), LcmOutput(LcmSettings())), True),
        ((ZenohOutput(ZenohSettings(tool_poses=True)), ZenohOutput(ZenohSettings())), True),
        ((ZenohOutput(ZenohSettings(prefix="a")), ZenohOutput(ZenohSettings(prefix="a"))), True),
        ((ZenohOutput(ZenohSettings(prefix="a")), ZenohOutput(ZenohSettings(prefix="b"))), False),
        ((LcmOutput(LcmSettings()), ZenohOutput(ZenohSettings())), False),
        ((MemoryOutput(), MemoryOutput()), False),
    ],
)
def test_outputs_of_the_same_settings_are_configured_alike(
    outputs: tuple[Output, Output], are_alike: bool
) -> None:
    first, second = outputs
    assert first.is_configured_like(first)
    assert first.is_configured_like(second) is are_alike
    assert second.is_configured_like(first) is are_alike
