"""Sending on LCM from the event loop: the states of a sender, what it logs, and when it retries."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import lcm
import pytest

from gateway.errors import OutputError
from gateway.outputs.lcm import connection as connection_module
from gateway.outputs.lcm import sender as sender_module
from gateway.outputs.lcm.connection import DEFAULT_GROUP, multicast_problem, open_lcm, send_problem
from gateway.outputs.lcm.sender import (
    CLOSED,
    NOT_OPEN,
    RETRY_S,
    LcmPublisher,
    LcmSender,
    LcmThreadSender,
    new_sender,
)
from tests.support.clocks import Clock
from tests.support.errors import each_names, names
from tests.support.networks import add_multicast_route, lcm_url, remove_multicast_route, slow_interface
from tests.support.records import logged
from tests.support.waiting import wait_until

BAD_URL = "udpm://not-an-address:7667"


@pytest.fixture
def shared() -> lcm.LCM:
    return lcm.LCM("memq://")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock(100.0)
    monkeypatch.setattr(sender_module, "time", SimpleNamespace(monotonic=clock))
    return clock


def refusal(send: Callable[[], object]) -> tuple[str, str]:
    """Return the text and the cause of the error."""
    with pytest.raises(OutputError) as caught:
        send()
    return str(caught.value), caught.value.cause


def send(sender: LcmSender) -> None:
    sender.send("CHANNEL", b"message")


# Opening and closing -------------------------------------------------------------------------


def test_messages_go_to_the_shared_object_between_opening_and_closing(
    shared: lcm.LCM, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    opened: list[str] = []
    received: list[tuple[str, bytes]] = []
    shared.subscribe(".*", lambda *each: received.append(each))
    sender = LcmSender("memq://", shared, lambda: opened.append(sender.problem))
    assert sender.problem == NOT_OPEN
    assert refusal(lambda: send(sender)) == (NOT_OPEN, "not open")
    sender.maintain()
    assert sender.problem == NOT_OPEN
    sender.open()
    assert (sender.problem, opened) == ("", [""])
    assert caplog.messages == ["lcm: sending messages to memq://"]
    send(sender)
    shared.handle_timeout(0)
    assert received == [("CHANNEL", b"message")]
    sender.close()
    sender.maintain()
    assert sender.problem == CLOSED
    assert refusal(lambda: send(sender)) == (CLOSED, "not open")


@pytest.mark.interpreted
def test_opening_is_tried_again_after_a_second_and_logged_once(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.outputs")
    sender = LcmSender(BAD_URL, None, lambda: None)
    sender.open()
    problem = sender.problem
    assert names(problem, BAD_URL, "lcm.url")
    assert refusal(lambda: send(sender)) == (problem, "not open")
    clock.now_s += RETRY_S - 0.001
    sender.maintain()
    assert len(caplog.records) == 1
    clock.now_s += 0.001
    sender.maintain()
    sender.maintain()
    assert [(each.level, each.args) for each in logged(caplog, logging.DEBUG)] == [
        ("WARNING", ("lcm", problem, "")),
        ("DEBUG", ("lcm", problem, 2)),
    ]


@pytest.mark.interpreted
def test_a_sender_that_has_opened_is_not_opened_again(shared: lcm.LCM, clock: Clock) -> None:
    """Although an attempt before had failed."""
    opened: list[bool] = []
    sender = LcmSender(BAD_URL, None, lambda: opened.append(True))
    sender.open()
    sender._shared = shared  # which needs no URL
    for _ in range(3):
        clock.now_s += RETRY_S
        sender.maintain()
    assert opened == [True]


@pytest.mark.parametrize(
    ("url", "sender_class"),
    [
        ("udpm://", LcmSender),
        ("mpudpm://", LcmSender),
        ("memq://", LcmSender),
        ("tcpq://lab:7700", LcmThreadSender),
        ("file:///tmp/log", LcmThreadSender),
    ],
)
def test_only_the_schemes_that_block_send_from_a_thread(url: str, sender_class: type) -> None:
    assert type(new_sender(url, None, lambda: None)) is sender_class


def test_a_file_is_complete_when_its_sender_is_closed(tmp_path: Path) -> None:
    """LCM has no ``close``: it keeps the end of a file in memory as long as something refers to it."""
    file, messages = tmp_path / "log.lcmlog", [bytes([number]) for number in range(10)]
    sender = new_sender(f"file://{file}?mode=w", None, lambda: None)
    sender.open()
    wait_until(lambda: not sender.problem)
    for message in messages:
        sender.send("CHANNEL", message)
    assert not sender.close()
    assert [event.data for event in lcm.EventLog(str(file))] == messages


# Failures ------------------------------------------------------------------------------------


@pytest.fixture
def without_route() -> Iterator[None]:
    remove_multicast_route()
    yield
    add_multicast_route()


@pytest.mark.netns
@pytest.mark.usefixtures("without_route")
@pytest.mark.parametrize("url", ["udpm://", f"udpm://{DEFAULT_GROUP}:7667", "mpudpm://239.1.2.3"])
def test_a_missing_route_is_the_reason_of_every_failure(url: str) -> None:
    text = (
        f"no multicast to {url}: [Errno 101] Network is unreachable; bring a network interface up, or give "
        "it a multicast route: ip route add 224.0.0.0/4 dev INTERFACE"
    )
    assert multicast_problem(url) == text
    assert refusal(lambda: open_lcm(url)) == (text, "not open")
    assert send_problem(url, OSError("of the test")) == text


@pytest.mark.netns
@pytest.mark.usefixtures("no_hold")
def test_a_lost_route_is_a_problem_until_a_message_is_sent(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    url = lcm_url()
    sender = LcmSender(url, None, lambda: None, "replies")
    sender.open()
    remove_multicast_route()
    try:
        failure, problem = refusal(lambda: send(sender)), multicast_problem(url)
    finally:
        add_multicast_route()
    assert problem
    assert failure == (problem, "send failed")
    assert sender.problem == failure[0]
    send(sender)
    assert sender.problem == ""
    sender.close()
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING", "INFO"]
    assert each_names(caplog.messages, ["replies", url], [problem], ["replies", url])


@pytest.mark.netns
def test_failures_in_quick_succession_are_logged_as_one(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    sender = LcmSender(lcm_url(), None, lambda: None)
    sender.open()
    caplog.clear()
    for _ in range(2):
        remove_multicast_route()
        try:
            refusal(lambda: send(sender))
        finally:
            add_multicast_route()
        send(sender)
        assert sender.problem == ""
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    sender.close()


@pytest.mark.parametrize("url", ["memq://", "file:///x?mode=w", "tcpq://127.0.0.1:7700", "nosuch://"])
def test_what_is_not_multicast_has_no_multicast_problem(url: str) -> None:
    assert multicast_problem(url) == ""


# Publishers ----------------------------------------------------------------------------------


def test_a_closed_publisher_says_so_and_frees_its_channel_once(shared: lcm.LCM) -> None:
    received: list[tuple[str, bytes]] = []
    shared.subscribe(".*", lambda *each: received.append(each))
    sender, channels = LcmSender("memq://", shared, lambda: None), {"MOCAP_LAB_3D"}
    sender.open()
    publisher = LcmPublisher("MOCAP_LAB_3D", "lab", sender, channels)
    assert publisher.wanted
    publisher.publish(b"message")
    publisher.close()
    assert channels == set()
    channels.add("MOCAP_LAB_3D")  # another publisher has it now
    publisher.close()
    assert channels == {"MOCAP_LAB_3D"}
    text, cause = refusal(lambda: publisher.publish(b"late"))
    assert cause == "closed"
    assert names(text, "MOCAP_LAB_3D")
    while shared.handle_timeout(0):
        pass
    assert received == [("MOCAP_LAB_3D", b"message")]


# An interface that is too slow ---------------------------------------------------------------


@pytest.mark.netns
def test_a_slow_interface_loses_messages_and_delays_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_module, "_SEND_BUFFER_BYTES", 4096)
    with slow_interface(100) as url:
        sender = LcmSender(url, None, lambda: None)
        sender.open()
        sender.send("CHANNEL", bytes(1400))

        def send_many() -> None:
            for _ in range(3000):  # of which 9 a second leave: a pause of a busy computer does not matter
                sender.send("CHANNEL", bytes(1400))

        text, cause = refusal(send_many)
        assert cause == "send failed"
        assert names(text, url, "lcm.max_rate_hz")
        sender.close()
