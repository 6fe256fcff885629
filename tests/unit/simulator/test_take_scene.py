"""TakeScene in virtual time: what is read ahead, how passes follow each other, and what cannot be played."""

import errno
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import General, Marker, Parameters, Parameters3D
from gateway.rtc3d.parameters_xml import encode_parameters, parse_parameters
from gateway.session.server.scene import NOT_YET_US
from gateway.simulator.take_frames import RecordedFrames
from gateway.simulator.take_scene import TakeScene
from gateway.takes.files.description import SourceDescription
from gateway.takes.files.event_log import SYNC
from tests.support.errors import raises
from tests.support.records import levels, logged
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    encode_event,
    frame,
    log_bytes,
    markers,
    parameters,
    write_take,
)
from tests.unit.session.server.wire import components_in

MARKERS = (ComponentType.MARKERS,)
GENERAL = General(name="the simulator")
XML = encode_parameters(
    Parameters(General(name="lab's server"), Parameters3D(100.0, markers=(Marker("7", "head"),)))
)


def take_of(count: int) -> list[Message]:
    return [description(), parameters(XML), *(markers(1, number) for number in range(count))]


class Player:
    """A take that is played; ``until`` advances it at one time until the thread has read enough."""

    def __init__(self, path: Path, messages: list[Message] | None) -> None:
        self.scene = TakeScene(path if messages is None else write_take(path, messages))
        self.scene.start()
        self.frames: RecordedFrames = self.scene.frames(MARKERS, 24)

    def until(self, elapsed_us: int, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + 120
        while not condition():
            assert time.monotonic() < deadline_s
            self.scene.advance(elapsed_us)
            time.sleep(0.001)

    def until_known(self, elapsed_us: int, tick: int) -> None:
        self.until(elapsed_us, lambda: self.frames.time_us(tick) != NOT_YET_US)


def frame_numbers(frames: RecordedFrames, first: int, stop: int) -> list[int]:
    """Return the frame numbers of the first component of some frames."""
    bodies = [frames.packet("big", tick).packet[8:] for tick in range(first, stop)]
    return [components_in(body)[0].frame_number for body in bodies]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "take.lcmlog"


def test_a_take_is_read_ahead_as_far_as_needed_and_a_new_client_gets_the_present_frames(path: Path) -> None:
    player = Player(path, take_of(3000))
    player.until_known(0, 300)
    for _ in range(20):
        player.scene.advance(0)
        time.sleep(0.002)
    assert player.frames.time_us(900) == NOT_YET_US
    assert player.scene.length_us is None
    for second in range(30):
        player.until_known(second * 1_000_000, second * 100)
    assert frame_numbers(player.frames, 2900, 3000) == list(range(2900, 3000))
    later = player.scene.frames(MARKERS, 24)
    tick = later.tick_after(29_000_000) - 1
    assert frame_numbers(later, tick, tick + 3) == [2900, 2901, 2902]
    player.scene.stop()


def test_a_take_starts_again_after_its_end_as_it_was(path: Path) -> None:
    player = Player(path, take_of(5))
    player.until_known(0, 14)
    assert frame_numbers(player.frames, 0, 15) == [0, 1, 2, 3, 4] * 3
    assert [player.frames.time_us(tick) for tick in range(15)] == list(range(0, 150_000, 10_000))
    assert player.scene.length_us == 50_000
    player.scene.stop()


def test_a_take_that_is_read_late_begins_late_and_loses_nothing(path: Path) -> None:
    player = Player(path, take_of(100))
    player.until_known(60_000_000, 0)
    assert (player.frames.time_us(0), player.frames.time_us(99)) == (60_000_000, 60_990_000)
    player.scene.stop()


# Parameters ---------------------------------------------------------------------------------


def test_parameters_and_their_sections_are_those_of_the_server(path: Path) -> None:
    scene = TakeScene(write_take(path, take_of(5)))
    for all_sections in ((), ("general", "3d", "6d", "analog", "force", "events")):
        assert scene.parameters_xml(all_sections, GENERAL) == XML
    for sections in (("3d",), ("general", "3d"), ("3d", "force")):
        found = parse_parameters(scene.parameters_xml(sections, GENERAL)).parameters
        assert found.markers == scene.parameters.markers
        assert (found.general is not None) == ("general" in sections)


def test_clients_get_the_parameters_of_the_present_frame(path: Path) -> None:
    other = XML.replace(b"head", b"foot")
    before = [markers(1, number, version=1) for number in range(100)]
    after = [markers(1, number, version=2) for number in range(100, 200)]
    player = Player(path, [parameters(XML), *before, parameters(other, 2), *after])
    player.until_known(990_000, 199)
    start_us = player.frames.time_us(0)
    for elapsed_us, xml in ((999_999, XML), (1_000_000, other)):
        player.scene.advance(start_us + elapsed_us)
        assert player.scene.parameters_xml((), GENERAL) == xml
    player.scene.stop()


def at(number: int, period_us: int = 1000) -> dict[str, Any]:
    return {"timestamp_us": number * period_us, "utime": START_UTIME + number * period_us}


def test_without_parameters_they_are_those_of_frames(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    messages = [frame(ComponentType.ANALOG, [0.0, 1.0], number, **at(number)) for number in range(500)]
    for number in range(49, -1, -1):
        messages.insert(10 * number, markers(3, number, **at(number, 10_000)))
    messages.append(frame(ComponentType.EVENT, [(77, 0, 1, 2, 3)], **at(490)))
    scene = TakeScene(write_take(path, messages))
    found = scene.parameters
    assert found.markers == Parameters3D(100, markers=tuple(Marker(f"{n}", f"Marker {n}") for n in (1, 2, 3)))
    assert found.analog is not None
    assert [channel.frequency_hz for channel in found.analog.channels] == [1000, 1000]
    assert found.events is not None
    assert [event.id for event in found.events.events] == ["77"]
    assert [(each.level, each.args) for each in logged(caplog)] == [("WARNING", (str(path), "lab"))]
    assert parse_parameters(scene.parameters_xml(("3d",), GENERAL)).parameters.markers == found.markers


def test_derived_rates_that_differ_by_jitter_are_one_rate(path: Path) -> None:
    rng = random.Random(1)
    messages = []
    for number in range(300):
        for component, items in ((ComponentType.MARKERS, [(1, 2, 3, 0)]), (ComponentType.ANALOG, [1.0])):
            utime = START_UTIME + 10_000 * number + rng.randint(0, 9000)
            messages.append(frame(component, items, number, timestamp_us=0, utime=utime))
    messages.sort(key=lambda message: message[1][8:16])
    described = TakeScene(write_take(path, messages)).parameters
    assert described.markers is not None
    assert described.analog is not None
    assert described.markers.frequency_hz == described.analog.channels[0].frequency_hz


def test_parameters_that_cannot_be_read_are_sent_as_they_are(path: Path) -> None:
    messages = [parameters(b"no XML at all"), *(markers(1, number) for number in range(5))]
    scene = TakeScene(write_take(path, messages))
    assert scene.parameters_xml((), GENERAL) == b"no XML at all"
    assert scene.parameters == Parameters()


# Bad input ----------------------------------------------------------------------------------


def test_a_take_of_several_sources_needs_a_choice(path: Path) -> None:
    write_take(path, [*take_of(5), description("gym"), markers(2, 5, source="gym")])
    with raises(TakeError, "lab, gym", "--source"):
        TakeScene(path)
    assert TakeScene(path, "gym").parameters.markers is not None
    with raises(TakeError, "'hall'", "lab, gym"):
        TakeScene(path, "hall")


def test_a_damaged_channel_is_no_source(path: Path) -> None:
    _, message = markers(1, 100)
    scene = TakeScene(write_take(path, [*take_of(500), ("MOCAP_L@B_3D", message), ("XOCAP_LAB_3D", message)]))
    assert scene.parameters.markers is not None


@pytest.mark.parametrize(
    ("content", "options", "values"),
    [
        (None, {}, [os.strerror(errno.ENOENT)]),
        (encode_event(0, 0, b"OTHER", b"12345678"), {}, ["no"]),
        (log_bytes([description(), parameters(XML)]), {}, ["no frames"]),
        (log_bytes(take_of(100)), {"from_s": 10}, ["no frames", "lab", "10 s", "end"]),
        (log_bytes(take_of(100)), {"to_s": 0}, ["no frames", "lab", "beginning", "0 s"]),
    ],
)
def test_what_is_no_take_is_an_error(
    path: Path, content: bytes | None, options: dict[str, Any], values: list[str]
) -> None:
    if content is not None:
        path.write_bytes(content)
    with raises(TakeError, "take.lcmlog", *values):
        TakeScene(path, **options)


def test_damage_is_left_out_and_reported_once(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    channel, message = markers(1, 50)
    data = bytearray(log_bytes([*take_of(100), (channel, message[:-1]), (channel, b"unknown type")]))
    damaged = data.index(SYNC, 3000)
    data[damaged : damaged + 4] = b"XXXX"
    path.write_bytes(bytes(data))
    player = Player(path, None)
    player.until_known(0, 250)
    player.scene.stop()
    [record] = logged(caplog)
    assert (record.level, record.args[1], *record.args[3:]) == ("WARNING", 1, 1, 1)


def test_a_take_that_was_cut_off_is_reported(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Whoever plays it to others must know that there was more."""
    about = SourceDescription("lab", "MOCAP_LAB")
    begin = [(channel.decode(), message) for channel, message in about.beginning("walk", START_UTIME)]
    write_take(path, begin + take_of(5))
    TakeScene(path)
    [record] = logged(caplog)
    assert (record.level, record.args[1]) == ("WARNING", "lab")


def test_a_file_that_cannot_be_read_on_ends_the_take(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    player = Player(path, take_of(5))
    player.scene.stop()
    path.unlink()
    player.scene.start()
    player.until(0, lambda: player.scene.length_us is not None)
    assert levels(caplog) == ["ERROR"]
