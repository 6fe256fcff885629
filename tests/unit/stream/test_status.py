import time
from collections import Counter
from typing import Any

import pytest
import rtc3d

from gateway import __version__
from gateway.stream.clock import ServerClock
from gateway.stream.state import StreamState
from gateway.stream.status import (
    MAX_ERROR_LENGTH,
    MAX_LIMITATIONS,
    FrameRate,
    OutputHealth,
    OutputStatus,
    StreamStatus,
    clock_message,
    clock_model,
    now_utime,
    status_message,
)
from tests.waiting import wait_until

NO_CLOCK = {"has_clock": False, "offset_us": 0, "drift_ppm": 0.0, "uncertainty_us": 0.0, "samples": 0}


def fields_of(value: Any) -> Any:
    """Return an LCM object as a dictionary of all its fields, whatever they are."""
    if hasattr(value, "__slots__"):
        return {name: fields_of(getattr(value, name)) for name in value.__slots__}
    return [fields_of(item) for item in value] if isinstance(value, list) else value


def encoded_and_decoded(message: rtc3d.status_t) -> Any:
    return fields_of(rtc3d.status_t.decode(message.encode()))


def test_the_hosts_time_is_in_microseconds_since_the_unix_epoch() -> None:
    before_ns = time.time_ns()
    utime = now_utime()
    assert before_ns // 1000 <= utime <= time.time_ns() // 1000


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


def test_the_status_message_has_every_field() -> None:
    stream = StreamStatus(
        "3d 6d",
        state=StreamState.STREAMING,
        byte_order="little",
        rate="Frequency:60",
        session=3,
        frames_in=2**40,
        bytes_in=2**41,
        reconnects=2,
        restarts=4,
        lag_s=0.0125,
        drops=Counter({"unknown component": 5, "frame rejected": 1}),
        limitations=["the server refused Version 1.0: err-version", "no parameters"],
        last_error="Verbindung weg – Kabel prüfen",
        last_error_utime=1_700_000_000_000_000,
    )
    quiet = StreamStatus("analog", session=1)
    zenoh = OutputStatus("zenoh", Counter({"6d": 8, "3d": 9}), Counter({"no router": 2}))
    lcm = OutputStatus("lcm")
    before = now_utime()
    message = encoded_and_decoded(
        status_message(
            source="lab",
            server="192.0.2.20:3020",
            sequence=17,
            streams=[(stream, 59.5), (quiet, 0.0)],
            outputs=[(zenoh, OutputHealth(True)), (lcm, OutputHealth(False, "no multicast"))],
        )
    )
    assert before <= message["utime"] <= now_utime()
    assert message == {
        "utime": message["utime"],
        "capture_utime": message["utime"],
        "sequence": 17,
        "session": 4,
        "source": "lab",
        "server": "192.0.2.20:3020",
        "gateway_version": __version__,
        "num_streams": 2,
        "streams": [
            {
                "components": "3d 6d",
                "state": "streaming",
                "byte_order": "little",
                "rate": "Frequency:60",
                "frame_rate_hz": 59.5,
                "session": 3,
                "frames_in": 2**40,
                "bytes_in": 2**41,
                "reconnects": 2,
                "restarts": 4,
                "lag_ms": 12.5,
                "clock": NO_CLOCK,
                "num_drops": 2,
                "drops": [
                    {"name": "frame rejected", "count": 1},
                    {"name": "unknown component", "count": 5},
                ],
                "num_limitations": 2,
                "limitations": ["the server refused Version 1.0: err-version", "no parameters"],
                "last_error": "Verbindung weg – Kabel prüfen",
                "last_error_utime": 1_700_000_000_000_000,
            },
            {
                "components": "analog",
                "state": "waiting to reconnect",
                "byte_order": "",
                "rate": "",
                "frame_rate_hz": 0.0,
                "session": 1,
                "frames_in": 0,
                "bytes_in": 0,
                "reconnects": 0,
                "restarts": 0,
                "lag_ms": 0.0,
                "clock": NO_CLOCK,
                "num_drops": 0,
                "drops": [],
                "num_limitations": 0,
                "limitations": [],
                "last_error": "",
                "last_error_utime": 0,
            },
        ],
        "num_outputs": 2,
        "outputs": [
            {
                "name": "zenoh",
                "connected": True,
                "problem": "",
                "num_messages": 2,
                "messages": [{"name": "3d", "count": 9}, {"name": "6d", "count": 8}],
                "num_drops": 1,
                "drops": [{"name": "no router", "count": 2}],
            },
            {
                "name": "lcm",
                "connected": False,
                "problem": "no multicast",
                "num_messages": 0,
                "messages": [],
                "num_drops": 0,
                "drops": [],
            },
        ],
    }


def test_the_clock_message_has_every_field() -> None:
    stream = StreamStatus("3d 6d", session=1)
    before = now_utime()
    message = fields_of(rtc3d.clock_t.decode(clock_message(3, 17, stream).encode()))
    assert before <= message["utime"] <= now_utime()
    assert message == {
        "utime": message["utime"],
        "capture_utime": message["utime"],
        "sequence": 17,
        "session": 3,
        "components": "3d 6d",
        "clock": NO_CLOCK,
    }


def test_a_clock_that_is_known_is_told() -> None:
    clock = ServerClock()
    for number in range(8_000):  # 20 s at 400 Hz, with a gateway's clock that is 50 ppm faster
        timestamp_us = 2_500 * number
        clock.observe(timestamp_us, number, 1_700_000_000_000_000 + timestamp_us + timestamp_us // 20_000)
    assert clock.has_clock
    assert fields_of(clock_model(clock)) == {
        "has_clock": True,
        "offset_us": round(clock.offset_us),
        "drift_ppm": clock.drift_ppm,
        "uncertainty_us": clock.uncertainty_us,
        "samples": clock.samples,
    }
    assert clock.drift_ppm == pytest.approx(50, abs=1)


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


@pytest.mark.parametrize("counter", ["messages", "drops"])
def test_counts_stand_in_the_order_of_their_names(counter: str) -> None:
    output = OutputStatus("zenoh", **{counter: Counter("cab")})
    outputs = [(output, OutputHealth(True))]
    message = encoded_and_decoded(
        status_message(source="lab", server="s", sequence=0, streams=[], outputs=outputs)
    )
    assert [count["name"] for count in message["outputs"][0][counter]] == ["a", "b", "c"]
