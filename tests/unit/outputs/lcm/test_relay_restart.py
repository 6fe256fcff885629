"""What happens to requests and subscriptions when LCM's TCP relay goes away and comes back."""

import logging
from collections.abc import AsyncIterator, Iterator, Sequence

import lcm
import pytest
import rtc3d

from gateway.messages.decode import decode
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.lcm_relay import LcmRelay
from tests.waiting import wait_until, wait_until_async

REQUEST, REPLY = "MOCAP_LAB_PARAMETERS_REQUEST", "MOCAP_LAB_PARAMETERS_REPLY"


class _Service:
    """Answers every request about parameters with the same XML."""

    def serves(self, _source: str) -> bool:
        return True

    async def parameters(self, _source: str, _sections: Sequence[str], *, fresh: bool) -> ServerParameters:  # noqa: ARG002 - the contract's name
        return ServerParameters(b"<The_3D/>", 1, 1)


@pytest.fixture
def relay() -> Iterator[LcmRelay]:
    relay = LcmRelay()
    yield relay
    relay.close()


@pytest.fixture
async def output(relay: LcmRelay) -> AsyncIterator[LcmOutput]:
    output = LcmOutput(LcmSettings(url=relay.url))
    output.serve_queries(_Service())  # type: ignore[arg-type]  # it has the methods that LCM calls
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
    request = rtc3d.parameters_request_t()
    request.request_id, request.requester = request_id, "test"
    lcm.LCM(relay.url).publish(REQUEST, request.encode())
    await wait_until_async(lambda: replies)
    subscriber.close()
    return [reply.xml for reply in replies if reply.request_id == request_id]


async def test_requests_are_answered_again_after_the_relay_restarts(
    relay: LcmRelay, output: LcmOutput
) -> None:
    await wait_until_async(lambda: output.health().connected)
    assert await ask(relay, 1) == ["<The_3D/>"]
    relay.close()
    await wait_until_async(lambda: not relay.subscribed)
    relay.open()
    assert await ask(relay, 2) == ["<The_3D/>"]


async def test_a_lost_relay_is_logged_with_the_key_to_check(
    relay: LcmRelay, output: LcmOutput, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.outputs.lcm.receiver")
    await wait_until_async(lambda: output.health().connected and relay.subscribed)
    relay.close()
    await wait_until_async(lambda: len(caplog.messages) >= 2)
    relay.open()
    await wait_until_async(lambda: "after" in caplog.messages[-1])
    failure, lost, *_, found = caplog.messages
    assert failure.startswith("receiving LCM requests: ")
    assert "None" not in failure
    assert lost.startswith(f"lcm: no requests can be received: LCM did not send to {relay.url}: ")
    assert lost.endswith("; check lcm.url (this is lcm.queries_url)")
    assert "None" not in lost
    assert found.startswith("lcm: requests can be received, after ")


def test_a_subscriber_logs_a_lost_relay_and_can_be_closed(
    relay: LcmRelay, caplog: pytest.LogCaptureFixture
) -> None:
    subscriber = LcmSubscriber(lcm.LCM(relay.url), ".*", lambda *_: None)
    wait_until(lambda: relay.subscribed)
    relay.close()
    wait_until(lambda: caplog.messages)
    relay.open()
    subscriber.close()
    relay.close()  # before LCM frees the connection: it would connect again, and hold up this process
    [message] = caplog.messages
    assert message.startswith("lcm: the connection is lost, so no more messages arrive: ")


def test_a_subscriber_receives_again_when_the_relay_is_back(relay: LcmRelay) -> None:
    received: list[bytes] = []
    subscriber = LcmSubscriber(lcm.LCM(relay.url), ".*", lambda _channel, data: received.append(data))
    wait_until(lambda: relay.subscribed)
    relay.close()
    wait_until(lambda: not relay.subscribed)
    relay.open()
    wait_until(lambda: relay.subscribed)
    sender = lcm.LCM(relay.url)
    sender.publish("CHANNEL", b"message")
    wait_until(lambda: b"message" in received)
    subscriber.close()
    relay.close()
