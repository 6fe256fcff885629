"""What happens to requests and subscriptions when LCM's TCP relay goes away and comes back."""

import errno
import logging
import os
import socket
from collections.abc import AsyncIterator, Iterator

import lcm
import pytest
import rtc3d

from gateway.messages.decode import decode
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.receiver import LcmReceiver
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.support.errors import names
from tests.support.lcm_relay import LcmRelay
from tests.support.records import logged
from tests.support.waiting import wait_until, wait_until_async
from tests.unit.outputs.lcm.peer import XML, Service, request

REQUEST, REPLY = "MOCAP_LAB_PARAMETERS_REQUEST", "MOCAP_LAB_PARAMETERS_REPLY"


@pytest.fixture
def relay() -> Iterator[LcmRelay]:
    relay = LcmRelay()
    yield relay
    relay.close()


@pytest.fixture
async def output(relay: LcmRelay) -> AsyncIterator[LcmOutput]:
    output = LcmOutput(LcmSettings(url=relay.url))
    output.serve_queries(Service())  # type: ignore[arg-type]  # it has the methods that LCM calls
    output.announce("lab")
    output.start()
    yield output
    relay.close()  # first: a lost connection that LCM frees would connect again, and hold up this process
    await output.stop_queries()
    output.close()


async def ask(relay: LcmRelay, request_id: int) -> list[str]:
    """Send a request on a new connection; return the texts of the replies."""
    replies: list[rtc3d.parameters_reply_t] = []
    subscriber = LcmSubscriber(lcm.LCM(relay.url), REPLY, lambda _, data: replies.append(decode(data)))
    await wait_until_async(lambda: REPLY in relay.subscribed and f"^{REQUEST}$" in relay.subscribed)
    lcm.LCM(relay.url).publish(REQUEST, request(request_id))
    await wait_until_async(lambda: replies)
    subscriber.close()
    return [reply.xml for reply in replies if reply.request_id == request_id]


async def test_a_lost_relay_is_logged_and_requests_are_answered_again_when_it_is_back(
    relay: LcmRelay, output: LcmOutput, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.outputs.lcm.receiver")
    await wait_until_async(lambda: output.health().connected)
    assert await ask(relay, 1) == [XML.decode()]
    relay.close()
    await wait_until_async(lambda: len(caplog.messages) >= 2 and not relay.subscribed)
    relay.open()
    assert await ask(relay, 2) == [XML.decode()]  # after the receiver has subscribed again
    failure, lost, *_, found = (each for each in caplog.records if each.name.endswith("receiver"))
    assert [each.levelname for each in (failure, lost, found)] == ["DEBUG", "WARNING", "INFO"]
    assert names(lost.message, "lcm", relay.url, "lcm.queries_url")
    assert "None" not in failure.message + lost.message


def test_a_subscriber_logs_a_lost_relay_and_receives_again_when_it_is_back(
    relay: LcmRelay, caplog: pytest.LogCaptureFixture
) -> None:
    received: list[bytes] = []
    subscriber = LcmSubscriber(lcm.LCM(relay.url), ".*", lambda _channel, data: received.append(data))
    wait_until(lambda: relay.subscribed)
    relay.close()
    wait_until(lambda: caplog.messages and not relay.subscribed)
    relay.open()
    wait_until(lambda: relay.subscribed)
    lcm.LCM(relay.url).publish("CHANNEL", b"message")
    wait_until(lambda: b"message" in received)
    subscriber.close()
    relay.close()  # before LCM frees the connection: it would connect again, and hold up this process
    assert [(each.level, each.args[0]) for each in logged(caplog)] == [("WARNING", "lcm")]


async def test_requests_are_received_once_there_are_file_descriptors(
    relay: LcmRelay, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The thread that receives them tries again, and says what is missing, instead of ending."""
    pairs = [socket.socketpair()]

    def pair_at_the_second_call() -> tuple[socket.socket, socket.socket]:
        if "no requests can be received" in caplog.text:
            return pairs.pop()
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr("gateway.outputs.lcm.connection.socket.socketpair", pair_at_the_second_call)
    receiver = LcmReceiver(relay.url, "MOCAP", None, lambda: None)
    received: list[bytes] = []
    receiver.add(REQUEST, received.append)
    receiver.start()
    await wait_until_async(lambda: f"^{REQUEST}$" in relay.subscribed)
    monkeypatch.undo()
    lcm.LCM(relay.url).publish(REQUEST, b"request")
    await wait_until_async(lambda: received == [b"request"])
    relay.close()
    await receiver.close()
    assert "Too many open files" in caplog.text
