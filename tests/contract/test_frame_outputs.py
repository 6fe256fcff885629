"""What ``gateway.outputs.contract`` promises, for every output that takes whole frames, with a real peer.

The sources are published by the gateway's own FanOut, so what an output refuses is counted as in the gateway.
What only one output promises is tested with that output.
"""

import asyncio
import importlib
import importlib.util
import itertools
import os
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, Final

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import FramePublisher, Output
from gateway.outputs.registry import OUTPUTS
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.parameters import Parameters
from gateway.worker_thread import make_call
from tests.contract.frame_rigs import (
    ALL,
    HALL,
    LAB,
    SOURCES,
    ExampleRig,
    FrameRig,
    NoQueries,
    component,
    frame,
    frame_of,
    labelled,
    odd_frames,
    server_parameters,
    stamp,
    tools,
    world,
)
from tests.losses import amounts
from tests.waiting import wait_until_async

RETURNS_WITHIN_S: Final = 5.0
TIMEOUT_S: Final = 30.0
"""How long data may take to reach a peer on a busy computer."""

MAINTENANCE_S: Final = 0.1
"""The gateway calls ``maintain`` once a second."""

NUM_STALLED: Final = 3000
NUM_LABELS: Final = 5000

WEIRD_LABELS: Final = (
    *("", " ", "/", "//", "a/b", "..", "*", "$*", "#", "?", "@", "%2F", "{}", "~", "-", "0", "7th", "tf"),
    *(
        "Probe 1",
        "probe_1",
        "PROBE 1",
        "Probe 1",
        "\n",
        "\t",
        "\x00",
        "\x1b[2J",
        "\u202e",
        "\ud7ff",
        "é",
        "左足",
        "🦶",
    ),
    *("a" * 300, "é" * 300, "<b>", "&amp;", '"', "'", "\\", "status", "clock", "json", "None", "nan"),
)

GARBAGE: Final = {
    "nothing": b"",
    "one byte": b"\x00",
    "zeros": bytes(100_000),
    "ones": b"\xff" * 100_000,
    "HTTP": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "an endless header": b"GET / HTTP/1.1\r\n" + b"X: " + b"x" * 1_000_000,
    "TLS": bytes.fromhex("16030100f5010000f10303") + bytes(234),
    "SSH": b"SSH-2.0-OpenSSH_9.7\r\n",
    "VRPN of another version": b"vrpn: ver. 99.99  9".ljust(24, b"\x00"),
    "a cookie, then a body of 2 GB": b"vrpn: ver. 07.35  0".ljust(24, b"\x00") + b"\x7f\xff\xff\xff" * 6,
    "an RTC3D packet of 4 GB": b"\xff\xff\xff\xff\x00\x00\x00\x01Version 1.0",
    "an RTC3D command without end": b"\x00\x10\x00\x00\x00\x00\x00\x01" + b"StreamFrames " * 1000,
    "an RTC3D command of zeros": b"\x00\x00\x00\x10\x00\x00\x00\x01" + bytes(8),
    "half a WebSocket handshake": b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nSec-WebSocket-Key: x\r\n\r\n",
    "text": "à la carte\r\n".encode() * 10_000,
}
"""What programs send that speak another protocol, or none."""


def _rig_of(name: str) -> type[FrameRig] | None:
    module = f"tests.contract.{name}_rig"
    if importlib.util.find_spec(module) is None:
        return None
    rig: type[FrameRig] = importlib.import_module(module).Rig
    return rig


RIGS: Final = {"example": ExampleRig} | {name: rig for name in OUTPUTS if (rig := _rig_of(name)) is not None}
"""The rig of each output that takes whole frames."""


def rigs(is_chosen: Callable[[type[FrameRig]], bool] = lambda _: True) -> pytest.MarkDecorator:
    """Run a test with the rigs for which ``is_chosen``."""
    chosen = [pytest.param(rig, id=name) for name, rig in RIGS.items() if is_chosen(rig)]
    return pytest.mark.parametrize("lab", chosen, indirect=True)


every_rig = rigs()
can_be_cut = rigs(lambda rig: rig.listens or rig.has_router)
has_router = rigs(lambda rig: rig.has_router)
listens = rigs(lambda rig: rig.listens)
knows_peers = rigs(lambda rig: rig.knows_peers)
is_exact = rigs(lambda rig: rig.is_exact)
converts = rigs(lambda rig: rig.converts)


class Lab:
    """A rig, and the sources of a gateway that publishes on its output."""

    def __init__(self, rig: FrameRig) -> None:
        self.rig = rig
        self.output = rig.output
        self.fan_outs: dict[str, FanOut] = {}
        self._numbers = itertools.count(1)
        self._outputs = [self.output]
        self.output.serve_queries(NoQueries())

    def replace_output(self) -> Output:
        """Close the output, and use a new one with the same settings."""
        self.output = self.rig.output = self.rig.create()
        self.output.serve_queries(NoQueries())
        self._outputs.append(self.output)
        return self.output

    def serve(self, *sources: str) -> None:
        """Publish these sources, with the parameters of a small laboratory; none means all."""
        for source in sources or SOURCES:
            self.fan_outs[source] = FanOut(source, [self.output])
            self.set_parameters(source, labelled())

    def set_parameters(
        self, source: str, parsed: Parameters, version: int = 1, frame: CoordinateFrame | None = None
    ) -> None:
        self.output.publish_parameters(source, server_parameters(parsed, version, frame))

    async def open(self) -> None:
        """Start the output, and wait until it is open."""
        self.output.start()
        await wait_until_async(lambda: self.output.health().connected, TIMEOUT_S)

    async def start(self) -> None:
        """Open the output, publish all sources, and connect a peer that receives them."""
        self.serve()
        await self.open()
        await self.subscribe()

    async def subscribe(self) -> None:
        """Connect a peer, and wait until it receives every source that is published."""
        await asyncio.to_thread(self.rig.subscribe)
        for source in self.fan_outs:
            await self.arrives(source)

    def publish(self, source: str, to_publish: Frame, at: Stamp | None = None) -> None:
        self.fan_outs[source].publish(to_publish, at or stamp(), ALL)

    def publish_next(self, source: str = LAB) -> int:
        """Publish a frame with all components; return its number."""
        number = next(self._numbers)
        self.publish(source, frame(number))
        return number

    async def arrives(self, source: str = LAB) -> None:
        """Publish frames until one of them arrives."""
        sent = []

        def has_arrived() -> bool:
            sent.append(self.publish_next(source) / 1000)
            return any(x in sent for x in self.xs(source))

        await wait_until_async(has_arrived, TIMEOUT_S)

    async def arrives_next(self, source: str = LAB) -> None:
        """Publish a frame, and wait until it arrives."""
        x = self.publish_next(source) / 1000
        await wait_until_async(lambda: x in self.xs(source), TIMEOUT_S)

    def xs(self, source: str = LAB) -> list[float]:
        """Return what has arrived of a source, rounded to µm."""
        return [round(x, 6) for each, x in list(self.rig.received) if each == source]

    def lost(self, source: str = LAB) -> dict[str, int]:
        """Return how many messages of a source were lost, by cause."""
        [(_, status)] = self.fan_outs[source].outputs
        return {cause: messages for cause, (messages, _) in amounts(status.losses).items()}

    def sent(self, source: str = LAB) -> Mapping[str, int]:
        """Return how many messages of a source count as sent."""
        [(_, status)] = self.fan_outs[source].outputs
        return status.messages

    def wanted(self, source: str = LAB) -> bool:
        return self.fan_outs[source].has_subscribers(WIRE_ORDER)

    async def maintain(self) -> None:
        """Do what the gateway does once a second."""
        while True:
            for output in self._outputs:
                output.maintain()
            await asyncio.sleep(MAINTENANCE_S)

    async def close(self) -> None:
        for fan_out in self.fan_outs.values():
            fan_out.close()
        for output in self._outputs:
            await output.stop_queries()
            await asyncio.to_thread(output.close)
        await asyncio.to_thread(self.rig.close)


@pytest.fixture
async def lab(request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture) -> AsyncIterator[Lab]:
    """Run a test with a rig; no defect may be logged, in whatever thread it is noticed."""
    lab = Lab(request.param())
    maintenance = asyncio.create_task(lab.maintain())
    try:
        yield lab
    finally:
        maintenance.cancel()
        await lab.close()
    defects = [
        record.getMessage() for record in caplog.records if record.exc_info or record.levelname == "ERROR"
    ]
    assert not defects


async def returns(call: Callable[[], Any]) -> None:
    """Make a call in a thread that nobody has to wait for; fail if it does not return."""
    made: Future[None] = Future()
    threading.Thread(target=make_call, args=(made, call), daemon=True).start()
    await wait_until_async(made.done, RETURNS_WITHIN_S)
    made.result()


def offered(publisher: FramePublisher, to_publish: Frame) -> str:
    """Publish a frame; return the cause if it is refused, "" otherwise."""
    try:
        publisher.publish(to_publish, stamp(), 0, ALL)
    except OutputError as error:
        return error.cause if str(error) else "an error without a text"
    return ""


def names_remedy(lab: Lab) -> bool:
    health = lab.output.health()
    return not health.connected and any(remedy in health.problem for remedy in lab.rig.remedies)


def test_every_output_of_whole_frames_has_a_rig() -> None:
    for name, kind in OUTPUTS.items():
        if name not in RIGS:
            assert kind.create(kind.settings()).frame_publisher(LAB) is None, name


# Sending -------------------------------------------------------------------------------------


@every_rig
async def test_frames_arrive_in_order_under_the_name_of_their_source(lab: Lab) -> None:
    await lab.start()
    sent: dict[str, list[float]] = {source: [] for source in SOURCES}
    for _ in range(20):
        for source, xs in sent.items():
            xs.append(lab.publish_next(source) / 1000)
        await asyncio.sleep(0.005)
    for source, xs in sent.items():
        await wait_until_async(lambda source=source, xs=xs: xs[-1] in lab.xs(source), TIMEOUT_S)  # type: ignore[misc]
        assert [x for x in lab.xs(source) if x >= xs[0]] == xs
    assert {source: lab.lost(source) for source in SOURCES} == {source: {} for source in SOURCES}


@every_rig
async def test_publishing_needs_no_peer(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    for _ in range(10):
        lab.publish_next()
    assert lab.output.health().connected
    assert lab.lost() == {}


@is_exact
async def test_frames_that_nobody_receives_do_not_count_as_sent(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    for odd in odd_frames(1).values():
        lab.publish(LAB, odd)
    lab.fan_outs[LAB].publish_status(b"status")
    assert lab.sent() == {}
    await lab.subscribe()
    assert set(lab.sent()) == {"frame"}
    await asyncio.to_thread(lab.rig.unsubscribe)

    def no_longer_counts() -> bool:
        before = lab.sent()
        lab.publish_next()
        return lab.sent() == before

    await wait_until_async(no_longer_counts, TIMEOUT_S)


@every_rig
async def test_a_second_peer_receives_as_well(lab: Lab) -> None:
    await lab.start()
    before = len(lab.xs())
    await asyncio.to_thread(lab.rig.subscribe)

    def both_receive() -> bool:
        lab.publish_next()
        xs = lab.xs()[before:]
        return len(xs) > len(set(xs))

    await wait_until_async(both_receive, TIMEOUT_S)


@knows_peers
async def test_only_frames_for_peers_are_wanted(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    assert not lab.wanted(LAB)
    assert not lab.wanted(HALL)
    await lab.subscribe()
    assert lab.wanted(LAB)
    assert lab.wanted(HALL)
    await asyncio.to_thread(lab.rig.unsubscribe)

    def is_unwanted() -> bool:
        for source in SOURCES:
            lab.publish_next(source)
        return not any(lab.wanted(source) for source in SOURCES)

    await wait_until_async(is_unwanted, TIMEOUT_S)
    await lab.subscribe()


@knows_peers
async def test_each_change_of_what_is_wanted_is_reported_in_the_event_loop(lab: Lab) -> None:
    """If it is exact."""
    threads: list[str] = []
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    is_exact = lab.output.watch_wanted(LAB, lambda: threads.append(threading.current_thread().name))
    assert is_exact is lab.rig.is_exact
    lab.output.announce(LAB)
    lab.set_parameters(LAB, labelled())
    lab.serve(HALL)
    await lab.open()
    await asyncio.to_thread(lab.rig.subscribe)
    await wait_until_async(lambda: publisher.wants(WIRE_ORDER), TIMEOUT_S)
    if is_exact:
        await wait_until_async(lambda: threads, TIMEOUT_S)
        threads.clear()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await wait_until_async(lambda: not publisher.wants(WIRE_ORDER), TIMEOUT_S)
    if is_exact:
        await wait_until_async(lambda: threads, TIMEOUT_S)
    assert set(threads) <= {threading.current_thread().name}
    publisher.close()
    lab.output.withdraw(LAB)


# What frames may be ------------------------------------------------------------------------------


@every_rig
@pytest.mark.parametrize("name", odd_frames(1))
async def test_frames_may_lack_or_repeat_components(lab: Lab, name: str) -> None:
    await lab.start()
    number = lab.publish_next()
    odd = odd_frames(number)[name]
    lab.publish(LAB, odd)
    lab.publish(LAB, odd)
    await lab.arrives()
    assert lab.lost() == {}
    assert set(lab.xs()) <= {each / 1000 for each in range(1, number + 10_000)}


@every_rig
async def test_only_the_components_that_the_gateway_publishes_are_sent(lab: Lab) -> None:
    await lab.start()
    x = (number := lab.publish_next()) / 1000
    await wait_until_async(lambda: x in lab.xs(), TIMEOUT_S)
    lab.fan_outs[LAB].publish(frame(number + 500_000), stamp(), ALL - {ComponentType.TOOLS})
    await lab.arrives()
    if lab.rig.converts:
        assert not [each for each in lab.xs() if each > 500]


@every_rig
async def test_a_source_may_have_no_parameters(lab: Lab) -> None:
    for source in SOURCES:
        lab.fan_outs[source] = FanOut(source, [lab.output])
        lab.set_parameters(source, Parameters())
    await lab.open()
    await lab.subscribe()
    assert lab.lost() == {}


@every_rig
async def test_tools_may_come_and_go(lab: Lab) -> None:
    """With other labels and another number of them, as after a new definition in the server."""
    await lab.start()
    for version, num_tools in enumerate((5, 1, 3, 2), 2):
        lab.set_parameters(LAB, labelled(tools=[f"Tool {version} {at}" for at in range(num_tools)]), version)
        for number in (10_000 * version, 10_000 * version + 1):
            items = tools(number, *[np.nan] * (num_tools - 1))
            lab.publish(LAB, frame_of(component(number, ComponentType.TOOLS, items)), stamp(version))
    lab.set_parameters(LAB, labelled(), 6)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()
    assert not set(lab.lost()) - {"queue full"}


@every_rig
async def test_labels_may_be_no_valid_names(lab: Lab) -> None:
    await lab.start()
    lab.set_parameters(LAB, labelled(markers=WEIRD_LABELS, tools=WEIRD_LABELS), 2)
    for number in (1, 2):
        items = tools(number, *[np.nan] * (len(WEIRD_LABELS) - 1))
        lab.publish(LAB, frame_of(component(number, ComponentType.TOOLS, items)), stamp(2))
    await lab.arrives_next(HALL)
    lab.set_parameters(LAB, labelled(), 3)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
async def test_thousands_of_labels_disturb_nobody(lab: Lab) -> None:
    """What an output cannot send of them is counted; another source is served meanwhile."""
    await lab.start()
    labels = [f"label {at}" for at in range(NUM_LABELS)]
    lab.set_parameters(LAB, labelled(markers=labels, tools=labels), 2)
    markers = np.zeros(NUM_LABELS, ITEM_DTYPES[ComponentType.MARKERS])
    huge = frame_of(
        component(1, ComponentType.MARKERS, markers),
        component(1, ComponentType.TOOLS, tools(*range(1, NUM_LABELS + 1))),
        component(1, ComponentType.ANALOG, np.zeros(NUM_LABELS, ITEM_DTYPES[ComponentType.ANALOG])),
    )
    for _ in range(5):
        await returns(lambda: lab.publish(LAB, huge, stamp(2)))
        await lab.arrives_next(HALL)
    lab.set_parameters(LAB, labelled(), 3)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@converts
async def test_positions_are_in_metres_in_the_frame_of_the_source(lab: Lab) -> None:
    """A reload changes only the frame and the version: the parameters stay."""
    await lab.start()
    lab.set_parameters(LAB, labelled(), 2, world(1.0, turned=True, x_m=10.0))

    def has_arrived() -> bool:
        lab.publish(LAB, frame(3), stamp(2))  # again: on LSL, peers need another stream
        return 7.0 in lab.xs()

    await wait_until_async(has_arrived, TIMEOUT_S)


@converts
async def test_without_a_known_unit_no_position_is_sent_and_the_loss_is_counted(lab: Lab) -> None:
    await lab.start()
    lab.set_parameters(LAB, labelled(), 2, world(None))
    lab.publish(LAB, frame(1_000_000), stamp(2))
    await wait_until_async(lambda: lab.lost().get("unknown unit"), TIMEOUT_S)
    await lab.arrives_next(HALL)
    lab.set_parameters(LAB, labelled(), 3)
    await lab.arrives()
    assert not [x for x in lab.xs() if x >= 1000]


# Life cycle --------------------------------------------------------------------------------------


@every_rig
async def test_before_opening_health_has_the_reason_and_no_frame_waits(lab: Lab) -> None:
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    health = lab.output.health()
    assert not health.connected
    assert health.problem
    assert offered(publisher, frame(1)) in {"", "not open"}
    assert publisher.wants(WIRE_ORDER) in {True, False}


@every_rig
async def test_an_open_output_is_healthy(lab: Lab) -> None:
    await lab.open()
    assert lab.output.health().problem == ""


@every_rig
async def test_after_closing_frames_are_refused_or_unwanted_and_health_has_the_reason(lab: Lab) -> None:
    await lab.start()
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    await asyncio.to_thread(lab.output.close)
    health = lab.output.health()
    assert not health.connected
    assert health.problem
    assert offered(publisher, frame(1)) == "not open" or not publisher.wants(WIRE_ORDER)


@every_rig
async def test_an_output_that_was_never_started_can_be_closed_twice(lab: Lab) -> None:
    lab.serve()
    await asyncio.to_thread(lab.output.close)
    await asyncio.to_thread(lab.output.close)
    assert not lab.output.health().connected


@every_rig
async def test_closing_an_output_or_a_publisher_twice_is_safe(lab: Lab) -> None:
    await lab.start()
    publisher = lab.output.frame_publisher(LAB)
    assert publisher is not None
    await asyncio.to_thread(lab.output.close)
    await asyncio.to_thread(lab.output.close)
    publisher.close()
    publisher.close()
    assert offered(publisher, frame(1)) in {"closed", "not open"} or not publisher.wants(WIRE_ORDER)


@every_rig
async def test_a_closed_output_stays_closed(lab: Lab) -> None:
    await lab.open()
    await asyncio.to_thread(lab.output.close)
    lab.output.maintain()
    lab.serve()
    lab.publish_next()
    assert not lab.output.health().connected


@every_rig
async def test_an_output_can_be_replaced_by_one_with_the_same_settings(lab: Lab) -> None:
    """A reload closes the former one first: it has the port."""
    await lab.start()
    await asyncio.to_thread(lab.output.close)
    lab.replace_output()
    for fan_out in lab.fan_outs.values():
        fan_out.set_outputs([lab.output])
    for source in SOURCES:
        lab.set_parameters(source, labelled())
    await lab.open()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
async def test_a_reload_without_changes_disturbs_no_peer(lab: Lab) -> None:
    await lab.start()
    same = lab.rig.create()
    assert lab.output.is_configured_like(same)
    assert lab.output.take_over(same) is False
    await asyncio.to_thread(same.close)
    for source in SOURCES:
        await lab.arrives_next(source)


@every_rig
async def test_a_source_can_be_withdrawn_and_announced_again(lab: Lab) -> None:
    await lab.start()
    lab.fan_outs.pop(LAB).close()
    await lab.arrives_next(HALL)
    lab.serve(LAB)
    await asyncio.to_thread(lab.rig.unsubscribe)
    await lab.subscribe()


@every_rig
async def test_sources_can_be_announced_and_withdrawn_in_any_state(lab: Lab) -> None:
    def show() -> None:
        fan_out = FanOut(LAB, [lab.output])
        lab.set_parameters(LAB, labelled())
        for is_streaming in (True, True, False, False, True):
            fan_out.show_streaming(is_streaming)
        fan_out.publish(frame(1), stamp(), ALL)
        fan_out.close()

    show()
    await lab.open()
    show()
    assert lab.output.health().connected
    await asyncio.to_thread(lab.output.close)
    show()


# Without a network -----------------------------------------------------------------------------------


@can_be_cut
async def test_without_a_network_starting_raises_nothing_and_health_names_the_remedy(lab: Lab) -> None:
    await asyncio.to_thread(lab.rig.cut)
    lab.serve()
    lab.output.start()
    await wait_until_async(lambda: names_remedy(lab), TIMEOUT_S)
    lab.publish_next()
    assert set(lab.lost()) <= {"not open", "no router"}


@can_be_cut
async def test_an_output_started_without_a_network_recovers_by_itself(lab: Lab) -> None:
    await asyncio.to_thread(lab.rig.cut)
    lab.serve()
    lab.output.start()
    await wait_until_async(lambda: names_remedy(lab), TIMEOUT_S)
    await asyncio.to_thread(lab.rig.restore)
    await wait_until_async(lambda: lab.output.health().connected, TIMEOUT_S)
    await lab.subscribe()


@can_be_cut
async def test_closing_is_safe_without_a_network(lab: Lab) -> None:
    await asyncio.to_thread(lab.rig.cut)
    lab.serve()
    lab.output.start()
    await returns(lab.output.close)
    assert not lab.output.health().connected


@has_router
async def test_a_lost_router_is_reported_and_frames_leave_again_once_it_is_back(lab: Lab) -> None:
    await lab.start()
    await asyncio.to_thread(lab.rig.cut)
    await wait_until_async(lambda: names_remedy(lab), TIMEOUT_S)
    lab.publish_next()
    await asyncio.to_thread(lab.rig.unsubscribe)
    await asyncio.to_thread(lab.rig.restore)
    await wait_until_async(lambda: lab.output.health().connected, TIMEOUT_S)
    await lab.subscribe()


# Peers ------------------------------------------------------------------------------------------------


@every_rig
async def test_a_peer_that_never_reads_holds_up_nobody(lab: Lab) -> None:
    await lab.start()
    await asyncio.to_thread(lab.rig.stall)
    large = frame_of(
        component(1, ComponentType.MARKERS, np.zeros(1000, ITEM_DTYPES[ComponentType.MARKERS])),
        *(component(1, kind) for kind in WIRE_ORDER[1:]),
    )

    def publish_much() -> None:
        for _ in range(NUM_STALLED):
            with suppress(OutputError):
                lab.publish(LAB, large)
            time.sleep(0)

    await returns(publish_much)
    for source in SOURCES:
        await lab.arrives(source)
    await returns(lab.output.maintain)
    await returns(lab.output.close)


@listens
async def test_other_protocols_and_garbage_do_not_disturb_the_next_peer(lab: Lab) -> None:
    await lab.start()
    for data in (*GARBAGE.values(), os.urandom(10_000)):
        await returns(lambda data=data: attack(lab.rig, data))  # type: ignore[misc]
    await lab.arrives_next()
    await lab.subscribe()
    assert lab.output.health().connected


@listens
async def test_connections_that_say_nothing_do_not_keep_others_out(lab: Lab) -> None:
    lab.serve()
    await lab.open()
    assert lab.rig.tcp_port is not None
    silent = [
        await asyncio.to_thread(socket.create_connection, ("127.0.0.1", lab.rig.tcp_port)) for _ in range(20)
    ]
    try:
        await lab.subscribe()
    finally:
        for connection in silent:
            connection.close()


def attack(rig: FrameRig, data: bytes) -> None:
    """Send data to the ports of an output, close one connection at once and half-close another."""
    if rig.tcp_port is not None:
        for is_half_open in (False, True):
            with suppress(OSError), socket.create_connection(("127.0.0.1", rig.tcp_port), 1) as connection:
                connection.settimeout(0.2)
                connection.sendall(data)
                if is_half_open:
                    connection.shutdown(socket.SHUT_WR)
                connection.recv(65536)
    if rig.udp_port is not None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, suppress(OSError):
            sender.sendto(data[:60_000], ("127.0.0.1", rig.udp_port))
