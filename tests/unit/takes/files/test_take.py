"""``open_take``: the arrays hold what was recorded, under the right labels."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import rtc3d

from gateway.client.transport import QueryReply
from gateway.errors import SelectionError, TakeError
from gateway.messages.decode import decode
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    ForceChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)
from gateway.takes import open_take
from gateway.takes.files.description import SourceDescription
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.series import Series
from gateway.takes.files.statistics import take_statistics
from gateway.takes.files.take import TakeSource
from tests.support.errors import raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    encode_event,
    frame,
    markers,
    parameters,
    write_take,
)

NAN = math.nan
PARAMETERS = Parameters(
    markers=Parameters3D(200.0, "m", (Marker("1", "head"), Marker("2", " left "))),
    tools=Parameters6D(200.0, (Tool("1", "hand"),)),
    analog=ParametersAnalog((AnalogChannel("1", "EMG", unit="V", frequency_hz=2000.0),)),
    force=ParametersForce(
        (
            Plate(
                "1",
                "plate",
                1000.0,
                channels=(ForceChannel("1", unit="N"),) * 3 + (ForceChannel("4", unit="Nm"),),
            ),
        )
    ),
    events=ParametersEvents((EventDefinition("0x10", "jump"), EventDefinition("7", "land"))),
)


def labelled(*labels: str) -> Parameters:
    named = tuple(Marker(str(n), label) for n, label in enumerate(labels))
    return Parameters(markers=Parameters3D(100.0, "mm", named))


def lab(folder: Path, messages: Iterable[Message]) -> TakeSource:
    """Return the source "lab" of a take of these messages."""
    return open_take(write_take(folder / "a.lcmlog", messages)).sources["lab"]


def markers_in(source: TakeSource) -> Series:
    assert source.markers
    return source.markers


def test_each_component_has_its_values_labels_unit_and_rate(tmp_path: Path) -> None:
    messages = [description(), parameters(PARAMETERS)]
    for number in range(3):
        messages += [
            frame(ComponentType.MARKERS, [(1, 2, 3, 0.5), (NAN, NAN, NAN, 999)], number),
            frame(ComponentType.TOOLS, [(1, 0, 0, 0, 4, 5, 6, 0.2)], number),
            frame(ComponentType.ANALOG, [number], number),
            frame(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)], number),
        ]
    messages += [frame(ComponentType.EVENT, [(16, 5, -1, -1, -1), (9, 6, 1, 2, 3)], 3)]
    source = lab(tmp_path, messages)
    found, tools, analog = markers_in(source), source.tools, source.analog
    forces, events = source.forces, source.events
    assert tools
    assert analog
    assert forces
    assert events
    assert (source.server, source.gateway_version, source.malformed) == ("192.0.2.20:3020", "1.0", {})
    assert (found.labels, found.unit, found.rate_hz, len(found)) == (("head", "left"), "m", 200.0, 3)
    assert found.positions[0].tolist()[0] == [1, 2, 3]
    assert np.isnan(found.positions[:, 1]).all()
    assert found.is_visible.tolist() == [[True, False]] * 3
    for other in (analog, forces, events):
        with pytest.raises(TakeError):
            assert other.is_visible
    assert found.items["reliability"][0].tolist() == [0.5, 999]
    assert found.seconds.tolist() == [-0.002, 0.008, 0.018]
    assert found.sequence.tolist() == found.frame_number.tolist() == [0, 1, 2]
    assert found.timestamp_us.tolist() == [0, 10_000, 20_000]
    assert found.measured_rate_hz == 100.0
    paused = [markers(1, number, timestamp_us=(0, 10_000, 20_000, 900_000)[number]) for number in range(4)]
    without_times = [markers(1, number, timestamp_us=0) for number in range(3)]
    rates = [markers_in(lab(tmp_path, each)).measured_rate_hz for each in (paused, without_times)]
    assert rates == [100.0, 100.0]
    assert (tools.labels, tools.unit) == (("hand",), "m")
    assert tools.positions[0].tolist() == [[4, 5, 6]]
    assert tools.quaternions[0].tolist() == [[1, 0, 0, 0]]
    assert (analog.labels, analog.units, analog.rate_hz) == (("EMG",), ("V",), 2000.0)
    assert analog.values.tolist() == [[0], [1], [2]]
    assert (forces.labels, forces.unit, forces.moment_unit) == (("plate",), "N", "Nm")
    assert forces.items["mz"].tolist() == [[6], [6], [6]]
    assert events.items["id"].tolist() == [16, 9]
    assert events.event_labels == ("jump", "")
    assert events.sequence.tolist() == [3, 3]
    assert [run.items["id"].tolist() for run in source.runs("event")] == [[16, 9]]


def test_columns_are_the_union_of_labels_and_absent_values_are_nan(tmp_path: Path) -> None:
    renamed = parameters(labelled("b", "c", ""), 2, utime=START_UTIME + 5000)
    messages = [parameters(labelled("a", "b"), 1), markers(2, 0, version=1), renamed]
    messages += [markers(3, 1, version=2), markers(1, 2, version=2)]
    found = markers_in(lab(tmp_path, messages))
    assert found.labels == ("a", "b", "c", "marker 3")
    x = found.items["x"]
    assert np.array_equal(x, [[0, 1, NAN, NAN], [NAN, 0, 1, 2], [NAN, 0, NAN, NAN]], equal_nan=True)
    runs = found.runs()
    assert [(run.labels, run.items["x"].tolist()) for run in runs] == [
        (("a", "b"), [[0, 1]]),
        (("b", "c", "marker 3"), [[0, 1, 2]]),
        (("b",), [[0]]),
    ]


def test_runs_end_where_the_server_or_the_gateway_starts_again(tmp_path: Path) -> None:
    steps: list[Message] = [
        markers(1, 0),
        markers(1, 1),
        markers(1, 2, timestamp_us=0),  # the server plays its file again
        markers(1, 3, timestamp_us=5_000),
        markers(1, 4, timestamp_us=10_000, session=2),
        markers(1, 6, timestamp_us=30_000, session=2),
        markers(1, 5, timestamp_us=20_000, session=2),  # overtaken on the network
        markers(1, 7, timestamp_us=0, session=2),  # has no time
        markers(1, 8, timestamp_us=(1 << 32) - 10_000, session=2),
        markers(1, 9, timestamp_us=0, session=2),
        markers(1, 10, timestamp_us=10_000, session=2),  # wrapped around
        markers(1, 11, timestamp_us=20_000, frame_number=3, session=2),
        markers(1, 2, utime=START_UTIME + 1_000_000, timestamp_us=30_000, frame_number=4, session=2),
    ]
    source = lab(tmp_path, steps)
    runs = [run.sequence.tolist() for run in source.runs("3d")]
    assert runs == [[0, 1], [2, 3], [4, 6, 5, 7, 8, 9, 10], [11], [2]]
    assert source.runs("6d") == []
    wrapped = [markers(1, number, frame_number=(2**31 - 1, -(2**31))[number]) for number in range(2)]
    assert len(lab(tmp_path, wrapped).runs("3d")) == 1


def test_versions_that_start_again_with_the_gateway_keep_their_own_labels(tmp_path: Path) -> None:
    again = parameters(labelled("b"), 1, utime=START_UTIME + 15_000)
    messages = [parameters(labelled("a"), 1), markers(1, 0), again, markers(1, 2)]
    found = markers_in(lab(tmp_path, messages))
    assert [run.labels for run in found.runs()] == [("a",), ("b",)]
    assert [found.parameters_of(row) for row in range(2)] == [labelled("a"), labelled("b")]


def test_parameters_that_cannot_be_read_are_counted_and_describe_nothing(tmp_path: Path) -> None:
    """The labels of other parameters would be wrong; the same ones may come with a new version."""
    again = [parameters(labelled("a"), 1), parameters(labelled("a"), 2), markers(1, 0, version=2)]
    source = lab(tmp_path, [*again, parameters(b"<broken", 3), markers(1, 1, version=3)])
    assert [run.labels for run in source.runs("3d")] == [("a",), ("marker 1",)]
    assert source.malformed == {"parameters": 1}


def test_limits_of_time_sources_and_components(tmp_path: Path) -> None:
    messages = [markers(1, number, source=source) for number in range(10) for source in ("lab", "b")]
    path = write_take(tmp_path / "a.lcmlog", messages)
    take = open_take(path, sources="b", components="3d", from_s=0.02, to_s=0.05)
    assert list(take.sources) == ["b"]
    assert markers_in(take.sources["b"]).sequence.tolist() == [2, 3, 4]
    assert open_take(path, components=["6d"]).sources["lab"].markers is None
    with raises(TakeError, "'c'", "lab, b"):
        open_take(path, sources=["c"])
    with raises(TakeError, "'3D'"):
        open_take(path, components="3D")


def test_messages_whose_size_contradicts_their_count_are_counted(tmp_path: Path) -> None:
    channel, message = markers(2, 1)
    malformed = [(channel, data) for data in (message[:-1], message + b"x", message[:20])]
    source = lab(tmp_path, [markers(2, 0), *malformed, markers(2, 2)])
    assert markers_in(source).sequence.tolist() == [0, 2]
    assert source.malformed == {"3d": 3}


def test_labels_that_change_without_end_are_read_in_runs(tmp_path: Path) -> None:
    many = [markers(10_000, 0)] + [markers(1, number) for number in range(1, 3000)]
    found = markers_in(lab(tmp_path, many))
    with pytest.raises(TakeError, match="runs"):
        _ = found.items
    assert [(len(run), len(run.labels)) for run in found.runs()] == [(1, 10_000), (2999, 1)]


def test_values_are_those_of_lcms_own_decoder(tmp_path: Path) -> None:
    messages = [markers(number % 4, number) for number in range(20)]
    found = markers_in(lab(tmp_path, messages))
    for row, (_, message) in enumerate(messages):
        decoded: rtc3d.markers_t = decode(message)
        expected = [(marker.x, marker.y, marker.z, marker.reliability) for marker in decoded.markers]
        assert [tuple(item) for item in found.items[row].tolist()][: decoded.num_markers] == expected


def test_what_comes_after_the_range_is_not_read(tmp_path: Path) -> None:
    path = write_take(tmp_path / "a.lcmlog", [markers(200, number) for number in range(3000)])
    with path.open("ab") as file:
        file.write(b"damage")
    take = open_take(path, to_s=1)
    assert len(markers_in(take.sources["lab"])) == 100
    assert take.num_damaged == 0
    assert open_take(path, from_s=29).num_damaged == 1


def test_a_key_that_begins_after_the_range_does_not_end_the_reading_of_others(tmp_path: Path) -> None:
    """A short take is read in one piece, in which everything that is wanted may come first."""
    late = frame(ComponentType.ANALOG, [1.0], utime=START_UTIME + 30_000_000)
    path = write_take(tmp_path / "a.lcmlog", [*(markers(1, number) for number in range(200)), late])
    assert len(markers_in(open_take(path, to_s=1).sources["lab"])) == 100


def test_takes_of_several_sources_in_one_file_are_told_apart(tmp_path: Path) -> None:
    """As after ``cat a.lcmlog b.lcmlog``. Each has one description of each source."""
    messages: list[Message] = []
    for number in range(3):
        messages += [description(source) for source in "abc"]
        messages += [markers(1, number, source=source) for source in "abc"]
    reader = TakeReader(write_take(tmp_path / "a.lcmlog", messages))
    batches = [batch for found in reader.batches() for batch in found]
    assert [batch.recording for batch in batches if batch.key == "3d"] == [0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_one_message_with_damaged_numbers_does_not_end_a_run(tmp_path: Path) -> None:
    numbers = [markers(1, number) for number in range(3)]
    odd_time = markers(1, 3, timestamp_us=2**50, frame_number=-7)
    odd_number = markers(1, 2**40, timestamp_us=50_000, frame_number=5)
    messages = [*numbers, odd_time, markers(1, 4), odd_number, markers(1, 6), markers(1, 7)]
    source = lab(tmp_path, messages)
    assert [len(run) for run in source.runs("3d")] == [8]


# Which source and key the channels belong to -------------------------------------------------


def pose(channel: str) -> Message:
    message = rtc3d.tool_pose_t()
    message.utime = START_UTIME
    return channel, message.encode()


def on(channel: str, message: Message | None = None) -> Message:
    return channel, (message or markers(1))[1]


def of(source: str) -> Message:
    return markers(1, source=source)


@pytest.mark.parametrize(
    ("messages", "keys"),
    [
        pytest.param(
            [description("lab"), description("lab-2"), of("lab"), of("lab_2")],
            ["lab take", "lab-2 take", "lab 3d", "lab-2 3d"],
            id="channels that share a beginning",
        ),
        pytest.param(
            [on("MY_OWN_HALL_B_TAKE", description("Hall-B")), on("MY_OWN_HALL_B_3D")],
            ["Hall-B take", "Hall-B 3d"],
            id="the description names the source, whatever the prefix",
        ),
        pytest.param([of("lab-2")], ["lab_2 3d"], id="the channel names it without a description"),
        pytest.param(
            [on("A_LAB_3D"), on("B_LAB_3D"), on("B_LAB_3D")],
            ["lab 3d", "b_lab 3d", "b_lab 3d"],
            id="one name under two prefixes is two sources",
        ),
        pytest.param(
            [
                *(of("lab"), of("lab-6d-x"), pose("MOCAP_LAB_6D_ARM_6D_TIP")),
                *(pose("MOCAP_LAB_6D_X_6D_HAND"), pose("MOCAP_NEW_6D_HAND")),
            ],
            ["lab 3d", "lab_6d_x 3d", "lab 6d/ARM_6D_TIP", "lab_6d_x 6d/HAND", "new 6d/HAND"],
            id="poses belong to the longest known source",
        ),
    ],
)
def test_messages_have_the_source_of_a_channel(
    tmp_path: Path, messages: list[Message], keys: list[str]
) -> None:
    reader = TakeReader(write_take(tmp_path / "take.lcmlog", messages))
    assert [f"{message.source} {message.key}" for message in reader.messages()] == keys


def test_a_pose_on_a_foreign_channel_is_unknown(tmp_path: Path) -> None:
    reader = TakeReader(write_take(tmp_path / "take.lcmlog", [markers(1, 0), pose("ARM")]))
    assert len(list(reader.messages())) == 1
    assert reader.unknown == {"ARM": 1}


# Takes that are not whole, or not one --------------------------------------------------------


def recorded(folder: Path, name: str, begin: int, *, num_lost: int = 0, has_end: bool = True) -> Path:
    """Write a take of ten frames as the gateway does; return its path."""
    about = SourceDescription("lab", "MOCAP_LAB")
    utime = START_UTIME + begin * 10_000
    messages = [(channel.decode(), message) for channel, message in about.beginning(name, utime)]
    messages += [markers(2, number) for number in range(begin, begin + 10)]
    if has_end:
        channel, message = about.end(utime + 100_000, num_lost)
        messages.append((channel.decode(), message))
    return write_take(folder / f"{name}.lcmlog", messages)


@pytest.mark.parametrize(
    ("num_lost", "has_end", "expected"),
    [(0, True, (0, False, False)), (7, True, (7, False, True)), (0, False, (0, True, True))],
)
def test_a_take_says_what_its_recorder_lacks(
    tmp_path: Path, num_lost: int, has_end: bool, expected: tuple[int, bool, bool]
) -> None:
    """Whoever analyses a take must be able to see that its end is missing."""
    path = recorded(tmp_path, "a", 0, num_lost=num_lost, has_end=has_end)
    take = open_take(path)
    source = take.sources["lab"]
    assert (source.num_lost, source.is_cut_off, take.was_cut_short) == expected
    assert not open_take(path, to_s=0.05).sources["lab"].is_cut_off  # nobody has looked there
    assert TakeReader(path).cut_off_sources() == ([] if has_end else ["lab"])
    joined = open_take([recorded(tmp_path, "b", 20), path])
    source = joined.sources["lab"]
    assert (source.num_lost, source.is_cut_off, joined.was_cut_short) == expected


def test_a_take_that_ends_within_a_long_message_is_cut_off(tmp_path: Path) -> None:
    """A disk that is full writes a part of it."""
    path = recorded(tmp_path, "a", 0, has_end=False)
    channel, message = markers(1000, 10)
    path.write_bytes(path.read_bytes() + encode_event(10, START_UTIME, channel.encode(), message)[:-100])
    assert TakeReader(path).cut_off_sources() == ["lab"]


def test_a_take_of_another_recorder_is_not_cut_off(tmp_path: Path) -> None:
    """lcm-logger writes no end."""
    reader = TakeReader(write_take(tmp_path / "a.lcmlog", [markers(1, 0)]))
    assert reader.cut_off_sources() == []


@pytest.mark.parametrize("order", ["ab", "ba", "aa", "bab"])
def test_takes_that_are_in_one_file_are_in_order_and_occur_once(tmp_path: Path, order: str) -> None:
    """``cat b a > c`` is what people do; times must not go back, and no frame may count twice."""
    paths = {"a": recorded(tmp_path, "a", 0), "b": recorded(tmp_path, "b", 3000)}
    both = tmp_path / "c.lcmlog"
    both.write_bytes(b"".join(paths[each].read_bytes() for each in order))
    take = open_take(both)
    found = take.sources["lab"].markers
    assert found is not None
    numbers = [*range(10), *(range(3000, 3010) if "b" in order else ())]
    assert found.sequence.tolist() == numbers
    assert found.seconds.tolist() == pytest.approx([number / 100 - 0.002 for number in numbers])
    statistics = take_statistics(both)
    assert statistics.start_utime == START_UTIME
    component = statistics.sources["lab"].components["3d"]
    assert component.last_utime - component.first_utime == (numbers[-1] - numbers[0]) * 10_000


def test_segments_of_a_take_are_not_takes_of_their_own(tmp_path: Path) -> None:
    """After a step of the clock, their times go back, and their order is still that of their names."""
    folder = tmp_path / "take"
    folder.mkdir()
    recorded(folder, "a", 3000)
    recorded(folder, "b", 0)
    found = open_take(folder).sources["lab"].markers
    assert found is not None
    assert found.sequence.tolist() == [*range(3000, 3010), *range(10)]


def test_summaries_are_short(tmp_path: Path) -> None:
    """A take has thousands of labels and megabytes of XML, and consoles print what they are given."""
    labels = [f"marker {number}" for number in range(500)]
    messages = [parameters(labelled(*labels)), *(markers(500, number) for number in range(3))]
    take = open_take(write_take(tmp_path / "a.lcmlog", messages))
    source = take.sources["lab"]
    assert source.markers is not None
    content = source.markers.content
    for each in (
        take,
        source,
        source.parameters[0],
        source.markers,
        content,
        QueryReply("lab", (), bytes(10_000)),
    ):
        assert len(repr(each)) < 100
    assert "lab" in repr(take)
    take.sources = {f"source {number}": source for number in range(1000)}
    assert len(repr(take)) < 200


@pytest.mark.parametrize(
    ("chosen", "similar"), [({"sources": "lob"}, "'lab'"), ({"components": "3D"}, "'3d'")]
)
def test_a_misspelt_choice_names_the_similar_one(
    tmp_path: Path, chosen: dict[str, str], similar: str
) -> None:
    """A source or a component that does not exist is mostly a slip of the finger."""
    with raises(SelectionError, similar):
        open_take(recorded(tmp_path, "a", 0), **chosen)  # type: ignore[arg-type]


def test_a_misspelt_component_has_no_runs(tmp_path: Path) -> None:
    """An empty list would say that the take lacks it."""
    source = open_take(recorded(tmp_path, "a", 0)).sources["lab"]
    assert source.runs("6d") == []
    with raises(SelectionError, *COMPONENTS_BY_KEY):
        source.runs("markers")
