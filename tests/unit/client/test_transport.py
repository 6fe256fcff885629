"""When gateways are queried about their sources, and what is said if nothing arrives from them."""

from unittest.mock import Mock

import pytest

from gateway.client.series import Source
from gateway.client.transport import silence_text
from gateway.display.live.live_data import LiveData


@pytest.mark.parametrize(
    ("reason", "sources", "text"),
    [
        ("no gateway found", [], "no gateway found"),
        ("", ["hall", "lab"], "a gateway serves hall, lab, but nothing arrives from it; try again"),
        ("", [], "a gateway serves this source, but nothing arrives from it; try again"),
    ],
)
def test_silence_has_a_reason_also_if_a_gateway_is_found(reason: str, sources: list[str], text: str) -> None:
    live = LiveData()
    for source in sources:
        live.source(source, source.upper(), is_known=True)
    assert silence_text(Mock(silence=lambda: reason), live) == text


def test_queries_without_a_reply_become_rarer(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1000.0
    monkeypatch.setattr("gateway.client.series.time.monotonic", lambda: now_s)
    source = Source("lab", "MOCAP_LAB")
    due_s = []
    for tick in range(36_000):  # an hour
        now_s = 1000.0 + tick / 10
        if source.begin_query():
            due_s.append(tick / 10)
    assert sum(time_s < 1 for time_s in due_s) >= 3
    assert 360 < len(due_s) < 450
    assert due_s[-1] > 3580
