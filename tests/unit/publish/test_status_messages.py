import logging
import socket
from collections import Counter
from typing import Any

import pytest
import rtc3d

from gateway import __version__
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.host_time import host_clock, now_utime
from gateway.outputs.contract import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, clock_model, status_message, unusable_frames
from gateway.runtime.losses import Losses
from gateway.session.clock import ServerClock
from gateway.session.process_clock import running_clock
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from tests.support.errors import names

NO_CLOCK = {"has_clock": False, "offset_us": 0, "drift_ppm": 0.0, "uncertainty_us": 0.0, "samples": 0}


def fields_of(value: Any) -> Any:
    """Return an LCM object as a dictionary of all its fields."""
    if hasattr(value, "__slots__"):
        return {name: fields_of(getattr(value, name)) for name in value.__slots__}
    return [fields_of(item) for item in value] if isinstance(value, list) else value


def encoded_and_decoded(message: rtc3d.status_t) -> Any:
    return fields_of(rtc3d.status_t.decode(message.encode()))


def test_the_status_message_has_every_field_and_counts_sorted_by_name() -> None:
    stream = StreamStatus(
        "3d 6d",
        state=StreamState.STREAMING,
        byte_order="little",
        rate="Frequency:60",
        session=3,
        parameters_version=5,
        frames_in=2**40,
        bytes_in=2**41,
        reconnects=2,
        restarts=4,
        lag_s=0.0125,
        limitations=["the server refused Version 1.0: err-version", "no parameters"],
        last_error="Verbindung weg – Kabel prüfen",
        last_error_utime=1_700_000_000_000_000,
    )
    for number in range(5):
        stream.losses.lost("unknown component", f"component {number}")
    stream.losses.lost("frame rejected", "too short")
    lost = Losses(logging.getLogger("tests"), "lab to zenoh")
    lost.lost("no router", "start it", messages=7, frames=2)
    quiet = StreamStatus("analog", session=4, parameters_version=5, tries=2)
    zenoh = OutputStatus("zenoh", Counter({"6d": 8, "event": 1, "3d": 9}), lost.report())
    lcm = OutputStatus("lcm")
    before = now_utime()
    message = encoded_and_decoded(
        status_message(
            source="lab",
            server="192.0.2.20:3020",
            sequence=17,
            streams=[(stream, 59.5), (quiet, 0.0)],
            outputs=[
                (zenoh, OutputHealth(True), {"ok": 5, "nothing-yet": 1}),
                (lcm, OutputHealth(False, "no multicast"), {}),
            ],
            stall_timeout_s=2.0,
            frame=CoordinateFrame("hall", 0.02, (0.0, 0.0, 1.0, 0.0), (1.0, 2.0, 3.0)),
        )
    )
    assert before <= message["utime"] <= now_utime()
    assert message == {
        "utime": message["utime"],
        "capture_utime": message["utime"],
        "sequence": 17,
        "session": 4,
        "parameters_version": 5,
        "source": "lab",
        "server": "192.0.2.20:3020",
        "gateway_version": __version__,
        "host": socket.gethostname(),
        "frame_id": "hall",
        "metres_per_unit": 0.02,
        "rotation_xyzw": (0.0, 0.0, 1.0, 0.0),
        "translation_m": (1.0, 2.0, 3.0),
        "num_streams": 2,
        "streams": [
            {
                "components": "3d 6d",
                "state": "streaming",
                "problem": "frames come, and all are rejected: too short",
                "tries": 0,
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
                    {"cause": "frame rejected", "messages": 1, "frames": 1},
                    {"cause": "unknown component", "messages": 5, "frames": 5},
                ],
                "num_limitations": 2,
                "limitations": ["the server refused Version 1.0: err-version", "no parameters"],
                "last_error": "Verbindung weg – Kabel prüfen",
                "last_error_utime": 1_700_000_000_000_000,
            },
            fields_of(rtc3d.stream_status_t())
            | {"components": "analog", "state": "waiting to reconnect", "tries": 2, "session": 4},
        ],
        "num_outputs": 2,
        "outputs": [
            {
                "name": "zenoh",
                "connected": True,
                "problem": "",
                "num_messages": 3,
                "messages": [{"name": name, "count": n} for name, n in (("3d", 9), ("6d", 8), ("event", 1))],
                "num_drops": 1,
                "drops": [{"cause": "no router", "messages": 7, "frames": 2}],
                "num_queries": 2,
                "queries": [{"name": "nothing-yet", "count": 1}, {"name": "ok", "count": 5}],
            },
            fields_of(rtc3d.output_status_t()) | {"name": "lcm", "problem": "no multicast"},
        ],
    }


def test_the_clock_message_has_every_field() -> None:
    stream = StreamStatus("3d 6d", session=1, parameters_version=5)
    before = now_utime()
    message = fields_of(rtc3d.clock_t.decode(clock_message(3, 17, stream).encode()))
    assert before <= message["utime"] <= now_utime()
    assert message == {
        "utime": message["utime"],
        "capture_utime": message["utime"],
        "sequence": 17,
        "session": 3,
        "parameters_version": 5,
        "components": "3d 6d",
        "clock": NO_CLOCK,
    }


def test_the_clock_model_has_every_field_of_a_known_clock() -> None:
    clock = ServerClock()
    for number in range(8_000):  # 20 s at 400 Hz, while the gateway's clock is 50 ppm faster
        timestamp_us = 2_500 * number
        clock.observe(timestamp_us, number, 1_700_000_000_000_000 + timestamp_us + timestamp_us // 20_000)
    assert clock.has_clock
    assert fields_of(clock_model(clock)) == {
        "has_clock": True,
        "offset_us": clock.offset_us + host_clock.offset_us,
        "drift_ppm": clock.drift_ppm,
        "uncertainty_us": clock.uncertainty_us,
        "samples": clock.samples,
    }
    assert clock.drift_ppm == pytest.approx(50, abs=1)


@pytest.mark.parametrize("first_us", [-(2**63), 2**63 - 10**8])
def test_the_offset_of_a_server_that_counts_from_any_number_fits_its_field(first_us: int) -> None:
    clock = ServerClock()
    for number in range(2_000):
        clock.observe(first_us + 2_500 * number, number, 2_500 * number)
    assert clock.has_clock
    message = clock_model(clock)
    encoded = rtc3d.clock_model_t.decode(message.encode())
    assert encoded.offset_us == min(host_clock.offset_us - first_us, 2**63 - 1)


async def test_frames_without_the_streams_components_are_a_problem_if_they_last() -> None:
    status = StreamStatus("3d")
    clock_s = running_clock().time()
    status.last_frame_s = clock_s - 4
    status.components_received("6d")
    status.last_frame_s = clock_s
    status.components_received("6d")
    assert names(unusable_frames(status, 3.0), "3d", "6d")
    assert unusable_frames(status, 100.0) == ""
    status.components_received("")
    assert unusable_frames(status, 3.0) == ""


async def test_rejected_frames_are_a_problem_as_long_as_no_others_come_and_they_still_do() -> None:
    """A measurement that ended with a bad frame leaves nothing that anybody could repair."""
    status = StreamStatus("3d")
    status.frame_rejected("too short", 1)
    assert names(unusable_frames(status, 100.0), "too short")
    assert unusable_frames(status, 0.0) == ""
    status.last_frame_s = running_clock().time()
    assert unusable_frames(status, 100.0) == ""
