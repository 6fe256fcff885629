"""The client of gateways as a library: what it makes of replies, and what it passes on."""

import contextlib
from typing import Any
from unittest.mock import Mock

import pytest

from gateway.client import GatewayAddress, GatewayClient, Messages
from gateway.client.sources import FINGERPRINTS
from gateway.client.transport import QueryReplies, QueryReply, silence_text
from gateway.errors import QueryError
from gateway.messages.encode import PREFIX
from gateway.outputs.contract import ServerParameters, encode_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.tools.display.live import LiveData
from tests.support.errors import names
from tests.support.networks import lcm_url
from tests.support.waiting import wait_until

CODES = ("disabled", "nothing-yet", "refused")


@pytest.mark.parametrize(
    ("source", "received", "action", "codes"),
    [
        (None, {"lab": {}}, "stop", CODES[2:]),
        (None, {"lab": {}}, "start", CODES[1:]),
        (None, {}, "stop", CODES),
        ("lab", {"lab": {}}, "stop", CODES),
    ],
)
def test_sources_that_are_not_concerned_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
    source: str | None,
    received: dict[str, Any],
    action: str,
    codes: tuple[str, ...],
) -> None:
    """Replies of several sources to one command for takes."""
    problems = [QueryError(code, code=code) for code in CODES]
    answers = [QueryReply(name, (), b"{}") for name in received]
    monkeypatch.setattr(GatewayClient, "_ask", lambda *_: QueryReplies(answers, problems))
    client = GatewayClient(GatewayAddress())
    replies = client.stop_take(source=source) if action == "stop" else client.start_take(source=source)
    assert replies.received == received
    assert tuple(problem.code for problem in replies.problems) == codes


@pytest.mark.netns
def test_messages_are_passed_on_with_their_source_and_key() -> None:
    """A program gets what it subscribed to without knowing keys and channels."""
    url = lcm_url()
    received: list[tuple[str, str, bytes]] = []
    client = GatewayClient(GatewayAddress(is_lcm=True, url=url))
    messages = Messages(lambda *message: received.append(message))
    frame = FINGERPRINTS["3d"] + PREFIX.pack(1_000_000, 1_000_000, 1, 1, 1) + bytes(16)
    parameters = encode_parameters(ServerParameters(b"<x/>", 1, 1), utime=1, arrived_utime=1, sequence=0)
    with contextlib.closing(client.subscribe(["lab"], ["3d"], messages)):
        sender = open_lcm(url)
        for channel, message in (("6D", frame), ("3D", frame), ("PARAMETERS", parameters)):
            sender.publish(f"MOCAP_LAB_{channel}", message)
        wait_until(lambda: len(received) == 2)
    assert received == [("lab", "3d", frame), ("lab", "parameters", parameters)]


@pytest.mark.parametrize(
    ("reason", "sources", "value"),
    [("the reason", [], "the reason"), ("", ["hall", "lab"], "hall, lab"), ("", [], "this source")],
)
def test_silence_has_a_reason_also_if_a_gateway_is_found(reason: str, sources: list[str], value: str) -> None:
    live = LiveData()
    for source in sources:
        live.source(source, source.upper(), is_known=True)
    assert names(silence_text(Mock(silence=lambda: reason), live), value)
