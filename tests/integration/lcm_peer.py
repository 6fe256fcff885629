"""A program that asks a gateway for parameters over LCM."""

from collections.abc import Sequence
from typing import Any

import rtc3d

from gateway.messages.decode import decode
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.waiting import wait_until_async

REQUEST, REPLY = "MOCAP_LAB_PARAMETERS_REQUEST", "MOCAP_LAB_PARAMETERS_REPLY"


class LcmPeer:
    """A program on LCM that sends requests and receives all replies and status messages."""

    def __init__(self, url: str, queries_url: str | None = None) -> None:
        self._lcm = open_lcm(queries_url or lcm_queries_url(url))
        self.replies: list[rtc3d.parameters_reply_t] = []
        self.statuses: list[rtc3d.status_t] = []
        self._subscribers = [
            LcmSubscriber(self._lcm, REPLY, lambda _, data: self.replies.append(decode(data))),
            LcmSubscriber(
                open_lcm(url), "MOCAP_LAB_STATUS", lambda _, data: self.statuses.append(decode(data))
            ),
        ]

    def send(self, data: bytes) -> None:
        self._lcm.publish(REQUEST, data)

    async def request(self, number: int = 1, sections: Sequence[str] = (), *, fresh: bool = False) -> Any:
        """Send a request and return its reply."""
        self.send(encode_request(number, sections, fresh=fresh))
        await wait_until_async(lambda: self.answers(number))
        [reply] = self.answers(number)
        return reply

    def answers(self, number: int) -> list[rtc3d.parameters_reply_t]:
        return [reply for reply in self.replies if reply.request_id == number]

    def ignored(self, cause: str) -> int:
        """Return how many requests were ignored for this cause, from the newest status."""
        drops = self.statuses[-1].outputs[0].drops if self.statuses else []
        return sum(loss.messages for loss in drops if loss.cause == cause)

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.close()


def encode_request(
    number: int, sections: Sequence[str] = (), *, fresh: bool = False, requester: str = "test"
) -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = number, requester, fresh
    message.sections, message.num_sections = list(sections), len(sections)
    encoded: bytes = message.encode()
    return encoded
