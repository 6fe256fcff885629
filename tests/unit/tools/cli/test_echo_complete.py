"""What ``echo --complete`` prints if its output is slow, if messages are lost, and of which components."""

import io
import json
from collections.abc import Sequence
from unittest.mock import Mock

import pytest

from gateway.client.history_requests import COMPLETE, HistoryAnswer, HistoryRequest
from gateway.client.sources import FINGERPRINTS, ReceivedSeries
from gateway.messages.encode import PREFIX
from gateway.messages.topics import lcm_channel
from gateway.tools.cli import echo_complete
from gateway.tools.cli.echo_complete import CompleteMessages, print_complete
from tests.support.errors import names

ANSWER_MESSAGES = 7


def frame(number: int) -> bytes:
    """Return markers without a marker, with this number."""
    utime = 1_000_000 + 1000 * number
    return FINGERPRINTS["3d"] + PREFIX.pack(utime, utime, number, 1, 1) + bytes(16)


class Gateway:
    """Publishes frames at once to whoever subscribes, and has all but the lost ones in its history."""

    def __init__(self, frames: int, published: Sequence[int], lost: range = range(0)) -> None:
        self.history = {number: frame(number) for number in range(frames) if number not in lost}
        self._published = published
        self._newest = frames - 1

    def subscribe(self, messages: CompleteMessages) -> Mock:
        messages.complete(self.answer, lambda *_: [], COMPLETE)
        source = messages.source("lab", "MOCAP_LAB", is_known=True)
        assert source is not None
        series = messages.series(source, "3d", "MOCAP_LAB_3D")
        assert series is not None
        for number in self._published:
            messages.receive(series, frame(number))
        assert messages.refill is not None
        return Mock(close=messages.refill.close)

    def answer(self, _series: ReceivedSeries, request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        first = int(request.options["from"])
        last = min(int(request.options.get("to", self._newest)), first + ANSWER_MESSAGES, self._newest)
        found = [self.history[number] for number in range(first, last + 1) if number in self.history]
        return HistoryAnswer(found, first, last, self._newest)


def printed(gateway: Gateway, count: int | None = None) -> tuple[list[int], bool]:
    """Return the numbers that are printed, and whether nothing is missing."""
    out = io.StringIO()
    messages = CompleteMessages(None, None, is_lcm=False)
    number, is_complete = print_complete(
        *(gateway.subscribe, messages, Mock(), out), count=count, seconds=0, as_json=True
    )
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert len(lines) == number
    assert {line["key"] for line in lines} == {"mocap/lab/3d"}
    return [line["sequence"] for line in lines], is_complete


def test_what_there_is_no_room_for_is_fetched_later(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Printing that is too slow loses nothing that the history still has, and memory is bounded."""
    monkeypatch.setattr(echo_complete, "MAX_WAITING", 20)
    assert printed(Gateway(100, range(100))) == ([*range(100)], True)
    assert names(capsys.readouterr().err, "79 messages", "no gaps")


def test_what_the_history_no_longer_has_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """The user and a script learn that the output is not complete, and what is missing."""
    numbers = [*range(5), *range(15, 20)]
    assert printed(Gateway(20, numbers, range(5, 12))) == ([*range(5), *range(12, 20)], False)
    fetched, lost, missing = capsys.readouterr().err.splitlines()
    assert names(fetched, "3 messages", "INCOMPLETE")
    assert names(lost, "7 messages")
    assert names(missing, "lab 3d", "5 to 11")


def test_what_is_still_to_be_fetched_at_the_end_is_not_called_lost(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With --count, the end comes while the history still has more."""
    gateway = Gateway(30, [0, 1, 2, *range(25, 30)])
    assert printed(gateway, count=3) == ([0, 1, 2], True)
    assert "no gaps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("component", "zenoh", "lcm"),
    [
        (None, {"3d", "6d", "6d/Tool%201", "6d/Tool%202"}, {"3d", "6d", "6d/TOOL_1", "6d/TOOL_2"}),
        ("6d", {"6d"}, {"6d"}),
        ("6d/*", {"6d/Tool%201", "6d/Tool%202"}, {"6d/TOOL_1", "6d/TOOL_2"}),
        ("6d/Tool 2", {"6d/Tool%202"}, {"6d/TOOL_2"}),
    ],
)
def test_only_the_component_is_printed_and_requested(
    component: str | None, zenoh: set[str], lcm: set[str]
) -> None:
    """The subscriber gets more than that, because one subscription is for all poses."""
    for is_lcm, wanted in ((False, zenoh), (True, lcm)):
        messages = CompleteMessages(component, None, is_lcm=is_lcm)
        messages.complete(Mock(), lambda *_: [], COMPLETE)
        source = messages.source("lab", "MOCAP_LAB", is_known=True)
        assert source is not None
        labels = ("TOOL_1", "TOOL_2") if is_lcm else ("Tool%201", "Tool%202")
        completed = set()
        for key in ("3d", "6d", *(f"6d/{label}" for label in labels)):
            series = messages.series(source, key, lcm_channel("MOCAP", "lab", *key.split("/")))
            assert series is not None
            if series.completion is not None:
                completed.add(key)
        assert completed == wanted
