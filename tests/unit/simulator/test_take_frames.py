"""The rules of §5.3.4 and §5.3.5 for recorded frames."""

import struct
from collections.abc import Iterable, Mapping, Sequence

import pytest

from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters import AnalogChannel, Marker, Parameters, Parameters3D, ParametersAnalog
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.session.server.client_session import ClientSession
from gateway.simulator.take_frames import RecordedFrames
from gateway.simulator.take_moments import Moment, RecordedParameters
from tests.unit.session.server.wire import WireComponent, components_in

NONE = RecordedParameters(b"")
_MARKERS = Parameters3D(100.0, markers=(Marker("1", "m"),))
_ANALOG = ParametersAnalog((AnalogChannel("1", "a", frequency_hz=1000.0),))
ANNOUNCED = RecordedParameters(encode_parameters(Parameters(markers=_MARKERS, analog=_ANALOG)))
MEASURED = {ComponentType.MARKERS: 100.0, ComponentType.TOOLS: 100.0, ComponentType.ANALOG: 1000.0}
SECOND_US = 1_000_000


def moment(due_us: int, numbers: Mapping[str, int], parameters: RecordedParameters = NONE) -> Moment:
    """Return a moment with components without items and with different frame numbers."""
    contents = {}
    for key, number in numbers.items():
        content = struct.pack(">iqi", number, 7_000_000 + due_us, int(key == "event"))
        event = struct.pack(">iqiii", number, due_us, -1, -1, -1) if key == "event" else b""
        contents[COMPONENTS_BY_KEY[key]] = content + event
    return Moment(due_us, 7_000_000 + due_us, parameters, contents)


def lab(
    seconds: float = 1.0, parameters: RecordedParameters = NONE, *, pause: tuple[float, float] = (0, 0)
) -> list[Moment]:
    """Return markers and tools at 100 Hz, analog at 1000 Hz; markers and tools pause from … to … (s)."""
    moments = []
    for number in range(round(seconds * 1000)):
        numbers = {"analog": number + 1}
        if number % 10 == 0 and not pause[0] <= number / 1000 < pause[1]:
            numbers |= {"3d": number // 10 + 1, "6d": number // 10 + 1}
        if number % 100 == 30:
            numbers["event"] = number // 100 + 1
        moments.append(moment(number * 1000, numbers, parameters))
    return moments


class Client:
    """A client's session on recorded frames; the test sets the time."""

    def __init__(self, moments: Iterable[Moment], *, is_end: bool = True, event_bytes: int = 24) -> None:
        self.moments = list(moments)
        self.event_bytes = event_bytes
        self.elapsed_us = -SECOND_US
        self.sources: list[RecordedFrames] = []
        self._is_end = is_end
        self.session = ClientSession(self)

    # SessionHost ----------------------------------------------------------------------------

    def frames(self, components: Sequence[ComponentType]) -> RecordedFrames:
        frames = RecordedFrames(components, self.event_bytes, MEASURED)
        frames.add(self.moments, is_end=self._is_end)
        self.sources.append(frames)
        return frames

    def parameters_xml(self, _sections: Sequence[str]) -> bytes:
        return b""

    def frames_requested(self) -> int:
        return self.elapsed_us

    def record_for(self, _duration_s: float | None) -> None:
        """Do nothing: these clients do not record."""

    # The client -----------------------------------------------------------------------------

    def send(self, text: str) -> None:
        self.session.answer(Packet(PacketType.COMMAND, text.encode()))

    def frames_until(self, seconds: float, byte_order: str = "big") -> list[list[WireComponent]]:
        found = []
        while self.elapsed_us < round(seconds * SECOND_US):
            self.elapsed_us = min(self.elapsed_us + 500_000, round(seconds * SECOND_US))
            for each in self.session.due_frames(self.elapsed_us):
                body = each.packet[8:]
                found.append(components_in(body, byte_order, event_bytes=self.event_bytes))  # type: ignore[arg-type]
        return found


def numbers(frames: list[list[WireComponent]]) -> list[dict[str, int]]:
    """Return the frame number of each component in each frame."""
    return [{ComponentType(each.type).key: each.frame_number for each in frame} for frame in frames]


def only(key: str, frames: list[list[WireComponent]]) -> list[int]:
    return [found[key] for found in numbers(frames) if key in found]


def streamed(moments: Iterable[Moment], request: str, seconds: float = 1.0) -> list[list[WireComponent]]:
    """Return the frames of a client that streams from the beginning."""
    found = Client(moments)
    found.send(f"StreamFrames {request}")
    return found.frames_until(seconds)


# Rates (§5.3.5) -----------------------------------------------------------------------------


@pytest.mark.parametrize("parameters", [NONE, ANNOUNCED])
def test_a_stream_has_the_rate_of_the_slowest_component(parameters: RecordedParameters) -> None:
    frames = streamed(lab(1, parameters), "3D Analog")
    assert numbers(frames) == [{"3d": k + 1, "analog": 10 * k + 1} for k in range(100)]


def test_contents_are_sent_as_recorded() -> None:
    event = WireComponent(5, 1, 7_030_000, [(1, 30_000, -1, -1, -1)])
    others = [WireComponent(kind, number, 7_030_000, []) for kind, number in ((1, 4), (4, 4), (2, 31))]
    assert streamed(lab(0.05), "All")[3] == [*others, event]


def test_a_component_that_is_missing_in_some_frames_costs_the_others_nothing() -> None:
    moments = [moment(k * 10_000, {"3d": k} if k % 3 else {"3d": k, "6d": k}, ANNOUNCED) for k in range(90)]
    frames = streamed(moments, "3D 6D", 2)
    assert (only("3d", frames), only("6d", frames)) == (list(range(90)), list(range(0, 90, 3)))


def test_while_the_slowest_component_pauses_or_has_not_begun_the_next_one_sets_the_rate() -> None:
    frames = streamed(lab(1, pause=(0.3, 0.7)), "3D 6D Analog", 2)
    assert only("3d", frames) == [*range(1, 31), *range(71, 101)]
    assert [each for each in only("analog", frames) if 300 < each <= 700] == list(range(316, 677))
    frames = streamed(lab(1, pause=(0, 0.5)), "All")
    assert only("3d", frames) == list(range(51, 101))
    assert only("analog", frames)[:400] == list(range(1, 401))


@pytest.mark.parametrize("batch", [1, 7, 200])
def test_the_frames_do_not_depend_on_how_much_is_read_at_once(batch: int) -> None:
    moments = lab(1, pause=(0.3, 0.7))
    pieces = Client([], is_end=False)
    pieces.send("StreamFrames All")
    for start in range(0, len(moments), batch):
        pieces.sources[0].add(moments[start : start + batch], is_end=start + batch >= len(moments))
    assert pieces.frames_until(2) == streamed(moments, "All", 2)


def test_a_pass_is_played_to_its_end_and_not_into_the_next_one() -> None:
    client = Client(lab(0.1))
    client.send("StreamFrames 3D Analog")
    client.sources[0].add([moment(100_000, {"3d": 1})], is_end=True)
    assert numbers(client.frames_until(1))[-1] == {"3d": 1}
    # Nothing follows that could set the rate, so the last samples must not wait for it.
    assert only("analog", streamed(lab(0.1, pause=(0.05, 0.1)), "3D Analog"))[-30:] == list(range(71, 101))


def test_a_frequency_counts_from_the_rate_that_was_recorded_not_the_announced_one() -> None:
    moments = [moment(k * 20_000, {"3d": k}, ANNOUNCED) for k in range(50)]
    assert only("3d", streamed(moments, "Frequency:25 3D")) == list(range(0, 50, 2))


def test_frames_become_due_as_they_become_known() -> None:
    moments = lab(2)
    client = Client(moments[:500], is_end=False)
    client.send("StreamFrames 3D Events")
    frames = client.frames_until(1)
    assert {client.session.due_us} == {None}
    client.sources[0].add(moments[500:], is_end=True)
    assert client.session.due_us == 500_000
    assert only("3d", frames + client.frames_until(2)) == list(range(1, 201))


def test_frames_that_nobody_takes_for_three_seconds_are_dropped_but_not_their_events() -> None:
    client = Client(lab(10))
    client.send("StreamFrames 3D Events")
    client.elapsed_us = 9_500_000
    frames = client.frames_until(10)
    assert (only("3d", frames)[0], client.session.frames_dropped) == (702, 701)
    assert [event[0] for event in frames[0][1].items] == list(range(1, 71))
    # Only some seconds of a take are in memory, and a client that sleeps longer is told its loss.
    client = Client(lab(20))
    client.send("StreamFrames Analog")
    client.sources[0].forget(10 * SECOND_US)
    client.elapsed_us = 10 * SECOND_US + 500_000
    assert only("analog", client.frames_until(11))[0] == 10_001
    assert client.session.frames_dropped == 10_000


# Events and SendCurrentFrame (§5.3.4) -------------------------------------------------------


def test_old_events_are_forgotten_except_for_some_thousands() -> None:
    """They are kept for clients that are late, but a take may have millions."""
    client = Client([moment(k * 1000, {"event": k}) for k in range(5000)])
    client.send("StreamFrames")
    [source] = client.sources
    source.forget(3 * SECOND_US)
    assert len(source._events.times_us) == 5000
    source.forget(5 * SECOND_US)
    assert len(source._events.times_us) == len(source._events.between(0, 5 * SECOND_US)) == 4096
    assert source._events.times_us[0] == 904_000


@pytest.mark.parametrize("requested", ["All", "Frequency:7 3D Events", "FrequencyDivisor:33 Events"])
def test_each_event_is_sent_once_with_a_frame(requested: str) -> None:
    frames = streamed(lab(10), requested, 10)
    sent = [event[0] for frame in frames for each in frame if each.type == 5 for event in each.items]
    assert sent == list(range(1, len(sent) + 1))
    assert len(sent) >= 95


def test_events_after_the_last_frame_are_sent_too_and_a_take_may_have_nothing_else() -> None:
    assert numbers(streamed([*lab(0.1), moment(105_000, {"event": 9})], "3D Events"))[-1] == {"event": 9}
    moments = [moment(k * 500_000, {"event": k}) for k in range(5)]
    assert numbers(streamed(moments, "", 3)) == [{"event": k} for k in range(5)]


@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_events_can_have_16_bytes(byte_order: str) -> None:
    client = Client(lab(0.1), event_bytes=16)
    client.send(f"SetByteOrder {byte_order}Endian")
    client.send("StreamFrames Events")
    assert client.frames_until(1, byte_order) == [[WireComponent(5, 1, 7_030_000, [(1, -1, -1, -1)])]]


def test_the_current_frame_of_what_the_take_lacks_is_empty() -> None:
    """A request must not wait for ever; the tests of the session prove everything else about requests."""
    client = Client(lab(1))
    client.elapsed_us = 123_456
    client.send("SendCurrentFrame Force")
    assert client.frames_until(0.5) == [[]]
