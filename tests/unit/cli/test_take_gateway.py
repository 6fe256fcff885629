"""Replies of several sources to one command for takes."""

from collections.abc import Mapping
from typing import Any

import pytest

from gateway.cli.take_gateway import GatewayAddress, TakeReplies
from gateway.errors import QueryError

PROBLEMS = [QueryError(code, code=code) for code in ("disabled", "nothing-yet", "refused")]


def address(source: str | None) -> GatewayAddress:
    return GatewayAddress(source, False, None, None, None, None, None, 1.0)


@pytest.mark.parametrize(
    ("source", "received", "action", "codes"),
    [
        (None, {"lab": {}}, "stop", ["refused"]),
        (None, {"lab": {}}, "start", ["nothing-yet", "refused"]),
        (None, {}, "stop", ["disabled", "nothing-yet", "refused"]),
        ("lab", {"lab": {}}, "stop", ["disabled", "nothing-yet", "refused"]),
    ],
)
def test_sources_that_are_not_concerned_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
    source: str | None,
    received: dict[str, Any],
    action: str,
    codes: list[str],
) -> None:
    def ask(_address: GatewayAddress, _options: Mapping[str, str]) -> TakeReplies:
        return TakeReplies(received, list(PROBLEMS))

    monkeypatch.setattr(GatewayAddress, "_ask_zenoh", ask)
    replies = address(source).ask({"set": action})
    assert replies.received == received
    assert [problem.code for problem in replies.problems] == codes
