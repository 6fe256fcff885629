import time

from gateway.messages.host_time import now_utime
from gateway.stream.status import MAX_ERROR_LENGTH, MAX_LIMITATIONS, FrameRate, StreamStatus
from tests.waiting import wait_until


def test_an_error_is_kept_with_its_time() -> None:
    status = StreamStatus("3d")
    before = now_utime()
    status.note_error("connection refused")
    assert status.last_error == "connection refused"
    assert before <= status.last_error_utime <= now_utime()


def test_of_a_long_error_the_beginning_is_kept() -> None:
    status = StreamStatus("3d")
    status.note_error("refused: " + 20_000_000 * "x")
    assert status.last_error.startswith("refused: xxx")
    assert len(status.last_error) == MAX_ERROR_LENGTH


def test_a_rate_is_frames_by_the_time_since_the_last_look() -> None:
    began_s = time.monotonic()
    rate = FrameRate()
    made_s = time.monotonic()
    wait_until(lambda: time.monotonic() > made_s)
    asked_s = time.monotonic()
    rate_hz = rate.update(100)
    told_s = time.monotonic()
    assert 100 / (told_s - began_s) <= rate_hz <= 100 / (asked_s - made_s)
    assert rate.update(100) == 0.0


def test_a_limitation_is_news_once_over_all_connections() -> None:
    stream = StreamStatus("3d")
    stream.begin_session()
    assert [stream.limit(text) for text in ("no Version", "no Version", "no XML")] == [True, False, True]
    stream.begin_session()
    assert stream.limitations == []
    assert [stream.limit(text) for text in ("no XML", "no Version", "no names")] == [False, False, True]
    assert stream.limitations == ["no XML", "no Version", "no names"]


def test_limitations_are_bounded() -> None:
    stream = StreamStatus("3d")
    news = [stream.limit(f"the server refused {number}") for number in range(100)]
    assert news == [number < MAX_LIMITATIONS for number in range(100)]
    assert len(stream.limitations) == MAX_LIMITATIONS
