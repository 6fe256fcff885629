"""Receiving from Zenoh, with a gateway of the test."""

import contextlib

import pytest
import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.recorder import FileWriter, TakeRecording
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns


def test_a_source_that_was_busy_has_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is asked for its parameters again; otherwise, its recording would have none."""

    def open_file(_sources: list[str]) -> FileWriter:
        raise AssertionError("nothing is recorded")

    def refuse_and_reply(query: zenoh.Query) -> None:
        query.reply_err("later", encoding=zenoh.Encoding("text/plain").with_schema("busy"))
        query.reply(query.key_expr, "<a/>")

    endpoint, answers = free_endpoint(), list[bool]()
    recording = TakeRecording(open_file)
    monkeypatch.setattr(
        recording, "answered", lambda _source, parameters: answers.append(parameters is not None)
    )
    with open_zenoh("router", listen=endpoint) as gateway:
        gateway.declare_queryable("mocap/lab/parameters", refuse_and_reply)
        client = GatewayClient(GatewayAddress(connect=endpoint))
        subscriber = client.subscribe(["lab"], None, recording)
        with contextlib.closing(client), contextlib.closing(subscriber):
            source = recording.source("lab", "MOCAP_LAB", is_known=True)
            assert source is not None
            subscriber._query(source)
            wait_until(lambda: True in answers)
    assert False not in answers
