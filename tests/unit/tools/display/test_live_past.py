"""What live data show of the last seconds before they began, which come from the gateway's history."""

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any, Final

import pytest

from gateway.client.history_requests import Completeness, HistoryAnswer, HistoryRequest
from gateway.client.queued_reception import QueuedSeries
from gateway.client.refill import KeptSeries
from gateway.client.sources import ReceivedSource
from gateway.errors import QueryError
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ComponentType
from gateway.tools.display import live as live_module
from gateway.tools.display.live import DisplayedSource
from tests.support.takes import frame
from tests.support.waiting import wait_until
from tests.unit.tools.display.live_lab import MISSING, Lab

ONE: Final = (1, 2, 3, 0.1)
NUM_MARKERS: Final = 1000
"""10 s at 100 Hz."""


class PastLab(Lab):
    """A source that had markers for 10 s, and one event 8 s ago.

    Its history answers when it ``may_answer``, and has messages of the ``silent`` keys.
    """

    def __init__(self) -> None:
        super().__init__()
        self.begin_utime = now_utime()
        self.may_answer = threading.Event()
        self.silent: tuple[str, ...] = ("event",)
        event = frame(ComponentType.EVENT, [(7, 0, 0, 0, 0)], utime=self.begin_utime - 8_000_000)[1]
        self.kept = {
            "3d": [self._message(number) for number in range(NUM_MARKERS)],
            "event": [event],
        }
        self.newest = {key: len(messages) - 1 for key, messages in self.kept.items()}
        """The number of the newest message of each key that was published."""
        self.failures: deque[str] = deque()
        """The codes with which the first questions about what it has are not answered."""
        self.live.complete(self._ask, self._find, Completeness(last_s=10, patience_s=60))

    def _message(self, number: int) -> bytes:
        items = [ONE if number < NUM_MARKERS / 2 else MISSING]
        utime = self.begin_utime - 10_000 * (NUM_MARKERS - number)
        return frame(ComponentType.MARKERS, items, number, utime=utime)[1]

    def send_next(self) -> None:
        """Send the frame with markers that follows those of the past."""
        self.newest["3d"] = NUM_MARKERS
        self.send(ComponentType.MARKERS, [MISSING], sequence=NUM_MARKERS, utime=self.begin_utime)

    def wait_for_past(self) -> DisplayedSource:
        """Return the source after everything of the past has come."""
        self.may_answer.set()
        wait_until(lambda: not any(series.is_past for series in self.live.all_series))
        return self.source

    def _ask(self, series: QueuedSeries, request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        assert self.may_answer.wait(60)
        messages = self.kept[series.key]
        first = 0 if request.last_s is not None else request.first
        last = min(first + 299, len(messages) - 1)
        return HistoryAnswer(messages[first : last + 1], first, last, self.newest[series.key])

    def _find(self, source: ReceivedSource, _last_s: float, _timeout_s: float) -> list[Any]:
        if self.failures:
            raise QueryError("no answer", code=self.failures.popleft())
        found: Any = source
        return [
            KeptSeries(self.live.series(found, key, f"MOCAP_LAB_{key.upper()}"), 0, 0) for key in self.silent
        ]


@pytest.fixture
def past() -> Iterator[PastLab]:
    lab = PastLab()
    yield lab
    lab.may_answer.set()
    assert lab.live.refill is not None
    lab.live.refill.close()


def test_messages_of_the_past_show_what_they_would_have_shown_in_their_time(past: PastLab) -> None:
    """Neither the rate nor the latency may say that 1000 frames came just now."""
    past.send_next()
    source = past.wait_for_past()
    markers = source.components["3d"]
    assert markers.batch.heads["sequence"].tolist() == [*range(NUM_MARKERS + 1)]
    assert markers.rate_hz == pytest.approx(100, abs=1)
    assert markers.visible_shares.tolist() == pytest.approx([0.5], abs=0.06)
    assert markers.latency.to_here is None
    assert not markers.latency.shown_ms
    assert not source.is_stopped
    past.send(ComponentType.MARKERS, [MISSING], sequence=NUM_MARKERS + 1)
    assert past.source.components["3d"].latency.to_here is not None


def test_an_event_of_the_past_is_listed_though_none_arrives_now(past: PastLab) -> None:
    past.send_next()
    assert [event.text.label for event in past.wait_for_past().events] == ["event 7"]


def test_an_event_of_the_past_is_listed_though_the_gateway_does_not_answer_at_first(past: PastLab) -> None:
    """Zenoh may still be connecting, or the gateway be busy; nothing else would ever show the event."""
    past.failures.extend(["no-gateway", "timeout", "busy", "zenoh"])
    past.may_answer.set()
    past.send_next()
    wait_until(lambda: past.source.events)
    assert not past.failures


def test_nothing_is_shown_in_fast_motion(past: PastLab) -> None:
    """While the past is coming, a component shows nothing old as if it were live."""
    past.kept["3d"] = past.kept["3d"][:600]
    past.may_answer.set()
    past.send_next()
    series = past.source.series_by_key["3d"]
    wait_until(lambda: series.num_messages >= 600)
    assert series.is_past  # 400 are still missing
    assert past.source.components["3d"].newest_head is None


def test_data_that_stopped_before_the_beginning_have_stopped_since_then(past: PastLab) -> None:
    """The picture must not look live, and say the right time; the status shows what time it is now."""
    past.kept["3d"] = past.kept["3d"][:600]
    past.newest["3d"] = 599
    past.silent = ("3d",)
    past.send_status(utime=past.begin_utime, sequence=1)
    past.may_answer.set()
    wait_until(lambda: past.live.sources["MOCAP_LAB"].series_by_key.get("3d"))
    markers = past.wait_for_past().components["3d"]
    assert len(markers.newest_items) == 1
    assert markers.age_s == pytest.approx(4, abs=0.1)
    assert markers.is_stopped


def test_what_waits_for_the_rest_of_the_past_is_bounded(
    past: PastLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_module, "MAX_WAITING_BYTES", 1000)
    past.kept["3d"] = past.kept["3d"][:600]
    past.may_answer.set()
    past.send_next()
    series = past.source.series_by_key["3d"]
    wait_until(lambda: series.num_messages >= 600)
    assert past.source.components["3d"].newest_head is not None
