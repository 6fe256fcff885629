"""The sender for tcpq and file, with an LCM object that blocks and fails on request."""

import logging
import threading
from collections.abc import Iterator

import pytest

from gateway.errors import OutputError
from gateway.outputs.lcm import sender as sender_module
from gateway.outputs.lcm.sender import CLOSED, NOT_OPEN, LcmThreadSender
from tests.support.errors import names
from tests.support.waiting import wait_until

pytestmark = pytest.mark.interpreted

URL = "tcpq://192.0.2.9:7700"
FULL = f"{URL} does not take messages fast enough; check the peer of lcm.url"


class FakeLcm:
    """Stands for LCM: ``opens`` and ``reads`` block the calls, ``error`` makes ``publish`` fail."""

    def __init__(self) -> None:
        self.opens = threading.Event()
        self.reads = threading.Event()
        self.opens.set()
        self.reads.set()
        self.open_error: OutputError | None = None
        self.error: OSError | None = None
        self.num_tried = 0
        self.is_publishing = threading.Event()
        self.published: list[tuple[str, bytes]] = []

    def open(self, _url: str) -> "FakeLcm":
        self.opens.wait()
        if self.open_error is not None:
            raise self.open_error
        return self

    def publish(self, channel: str, message: bytes) -> None:
        self.is_publishing.set()
        self.reads.wait()
        self.num_tried += 1
        if self.error is not None:
            raise self.error
        self.published.append((channel, message))


@pytest.fixture
def lcm(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeLcm]:
    fake = FakeLcm()
    monkeypatch.setattr(sender_module, "open_lcm_to_send", fake.open)
    monkeypatch.setattr(sender_module, "RETRY_S", 0.001)
    monkeypatch.setattr(sender_module, "_JOIN_S", 0.01)
    yield fake
    fake.opens.set()
    fake.reads.set()


@pytest.fixture
def sender(lcm: FakeLcm, monkeypatch: pytest.MonkeyPatch) -> Iterator[LcmThreadSender]:
    """Return an open sender of a short queue, whose ``close`` waits for the thread as long as it takes."""
    monkeypatch.setattr(sender_module, "MAX_QUEUED_MESSAGES", 2)
    monkeypatch.setattr(sender_module, "MAX_QUEUED_BYTES", 100)
    sender = LcmThreadSender(URL, lambda: None)
    sender.open()
    wait_until(lambda: not sender.problem)
    yield sender
    lcm.reads.set()
    lcm.error = None
    monkeypatch.setattr(sender_module, "_JOIN_S", 10.0)
    sender.close()


def send(sender: LcmThreadSender, *messages: bytes) -> None:
    for message in messages:
        sender.send("CHANNEL", message)


def refusal(sender: LcmThreadSender, message: bytes = b"refused") -> OutputError:
    with pytest.raises(OutputError) as caught:
        sender.send("CHANNEL", message)
    return caught.value


def messages(lcm: FakeLcm) -> list[bytes]:
    return [message for _, message in lcm.published]


def is_sent(sender: LcmThreadSender) -> bool:
    return not +sender._waiting


def block(lcm: FakeLcm, sender: LcmThreadSender) -> None:
    """Block the thread in its first message."""
    lcm.is_publishing.clear()
    lcm.reads.clear()
    send(sender, b"first")
    assert lcm.is_publishing.wait(10)


def test_messages_are_published_in_order_on_their_channels(lcm: FakeLcm, sender: LcmThreadSender) -> None:
    sent = [(f"CHANNEL_{number}", bytes([number])) for number in range(50)]
    for channel, message in sent:
        sender.send(channel, message)
        wait_until(lambda: is_sent(sender))
    assert lcm.published == sent


# The queue -----------------------------------------------------------------------------------


def test_the_queue_is_limited_in_bytes(lcm: FakeLcm, sender: LcmThreadSender) -> None:
    for _ in range(2):  # the bytes of published messages no longer count
        block(lcm, sender)
        send(sender, bytes(95))
        assert refusal(sender, bytes(6)).cause == "queue full"
        lcm.reads.set()
        wait_until(lambda: is_sent(sender))


@pytest.mark.usefixtures("no_hold")
def test_messages_beyond_the_queue_are_refused_until_the_peer_reads_again_and_logged_once(
    lcm: FakeLcm, sender: LcmThreadSender, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    block(lcm, sender)
    send(sender, b"second", b"third")
    assert sender.problem == ""
    for _ in range(3):
        error = refusal(sender)
        assert (error.cause, str(error)) == ("queue full", FULL)
    assert sender.problem == FULL
    lcm.reads.set()
    wait_until(lambda: is_sent(sender))
    send(sender, b"fourth")
    assert sender.problem == ""
    wait_until(lambda: messages(lcm) == [b"first", b"second", b"third", b"fourth"])
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]
    assert caplog.messages[0] == f"lcm: {FULL}"


def test_a_queue_that_is_often_full_is_logged_once(
    lcm: FakeLcm, sender: LcmThreadSender, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    for _ in range(2):
        block(lcm, sender)
        send(sender, b"second", b"third")
        refusal(sender)
        lcm.reads.set()
        wait_until(lambda: is_sent(sender))
    assert caplog.messages == [f"lcm: {FULL}"]


# Failures ------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_hold")
def test_a_message_that_fails_is_sent_again_and_others_are_refused_meanwhile(
    lcm: FakeLcm, sender: LcmThreadSender, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    lcm.error = BrokenPipeError("of the test")
    send(sender, b"first")
    wait_until(lambda: lcm.num_tried >= 3)
    error = refusal(sender)
    assert (error.cause, str(error)) == ("send failed", sender.problem)
    assert names(sender.problem, URL, "of the test", "lcm.url")
    lcm.error = None
    wait_until(lambda: not sender.problem)
    send(sender, b"second")
    wait_until(lambda: messages(lcm) == [b"first", b"second"])
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]
    assert names(caplog.messages[1], "lcm", URL)


def test_failures_in_quick_succession_are_logged_as_one(
    lcm: FakeLcm, sender: LcmThreadSender, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    for _ in range(2):
        lcm.error = BrokenPipeError("of the test")
        send(sender, b"message")
        wait_until(lambda: sender.problem)
        lcm.error = None
        wait_until(lambda: is_sent(sender))
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_opening_is_tried_again_until_it_succeeds(lcm: FakeLcm, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.outputs")
    opened = threading.Event()
    sender = LcmThreadSender(URL, opened.set)
    assert (refusal(sender).cause, sender.problem) == ("not open", NOT_OPEN)
    lcm.open_error = OutputError("nobody listens; start the relay", cause="not open")
    sender.open()
    wait_until(lambda: len(caplog.records) >= 3)
    assert (refusal(sender).cause, sender.problem) == ("not open", "nobody listens; start the relay")
    assert not opened.is_set()
    lcm.open_error = None
    assert opened.wait(10)
    send(sender, b"message")
    sender.close()
    assert messages(lcm) == [b"message"]
    assert caplog.messages[0] == "lcm: nobody listens; start the relay"
    levels = [record.levelno for record in caplog.records]
    assert (levels[0], levels[-1], set(levels[1:-1])) == (logging.WARNING, logging.INFO, {logging.DEBUG})


# Closing -------------------------------------------------------------------------------------


def test_closing_sends_what_is_queued(
    lcm: FakeLcm, sender: LcmThreadSender, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sender_module, "_JOIN_S", 10.0)
    block(lcm, sender)
    send(sender, b"second", b"third")
    threading.Timer(0.01, lcm.reads.set).start()
    sender.close()
    assert messages(lcm) == [b"first", b"second", b"third"]
    assert sender.problem == CLOSED
    assert (refusal(sender).cause, str(refusal(sender))) == ("not open", CLOSED)
    assert not caplog.records


def test_closing_does_not_wait_for_a_blocked_peer_and_returns_the_loss(
    lcm: FakeLcm, sender: LcmThreadSender
) -> None:
    block(lcm, sender)
    sender.send("CHANNEL", b"second", "lab")
    assert sender.close() == {"": 1, "lab": 1}
    lcm.reads.set()
    assert sender._worker.finish(10)
    assert (messages(lcm), sender.problem) == ([b"first"], CLOSED)


def test_closing_ends_the_attempts_to_send_again(lcm: FakeLcm, sender: LcmThreadSender) -> None:
    lcm.error = BrokenPipeError("of the test")
    send(sender, b"first")
    wait_until(lambda: sender.problem)
    sender.close()
    assert sender._worker.finish(10)
    assert sender.problem == CLOSED


def test_while_lcm_opens_the_problem_names_the_url_and_closing_is_final(lcm: FakeLcm) -> None:
    opened: list[bool] = []
    lcm.opens.clear()
    sender = LcmThreadSender(URL, lambda: opened.append(True))
    sender.open()
    assert (refusal(sender).cause, str(refusal(sender))) == ("not open", sender.problem)
    assert names(sender.problem, URL, "lcm.url")
    sender.close()
    lcm.opens.set()
    assert sender._worker.finish(10)
    assert (opened, sender.problem) == ([], CLOSED)
    assert refusal(sender).cause == "not open"
