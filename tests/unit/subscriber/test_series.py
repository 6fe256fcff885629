"""When gateways are queried about their sources."""

import pytest

from gateway.subscriber.series import Source


def test_queries_without_a_reply_become_rarer(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1000.0
    monkeypatch.setattr("gateway.subscriber.series.time.monotonic", lambda: now_s)
    source = Source("lab", "MOCAP_LAB")
    due_s = []
    for tick in range(36_000):  # an hour
        now_s = 1000.0 + tick / 10
        if source.begin_query():
            due_s.append(tick / 10)
    assert sum(time_s < 1 for time_s in due_s) >= 3
    assert 360 < len(due_s) < 450
    assert due_s[-1] > 3580
