"""Export to MCAP, read back by the package ``mcap``."""

import math
import os
import struct
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.errors import TakeError
from gateway.messages.foxglove.topics import FoxgloveTopic, TopicMessages
from gateway.messages.topics import lcm_channel
from gateway.rtc3d.components import MISSING, ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    ForceChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
    Tool,
)
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import TakePart
from gateway.takes.export.mcap_file import McapFile
from gateway.takes.files.parameters_history import ParametersEntry
from gateway.takes.files.take import TakeSource
from tests.support.errors import each_names, one_names, raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    details,
    frame,
    markers,
    parameters,
    scene_messages,
)
from tests.unit.takes.export.exported import export_messages, notes_of
from tests.unit.takes.export.read_mcap import (
    McapContent,
    assert_equals_take,
    floats_of,
    points_of,
    read_mcap,
    rotated,
)

SCENE = SyntheticScene(markers=30, tools=3, analog=40, plates=2, rate_hz=100, analog_rate_hz=1000)
NO_MARKER = (MISSING, MISSING, MISSING, 999.0)
NO_TOOL = (MISSING,) * 8


def one_of(interval: int) -> str:
    return f"arrows of forces drawn for one in {interval} frames"


def export(
    folder: Path, messages: Iterable[Message], *, notes: Sequence[str] = (), **options: Any
) -> McapContent:
    """Return what is exported. ``notes`` are texts that the notes about it have, one of each."""
    job = export_messages(folder, messages, "walk.mcap", **options)
    assert each_names(notes_of(job), *([note] for note in notes))
    return read_mcap(folder / "walk.mcap")


def unit(name: str) -> Message:
    return parameters(Parameters(markers=Parameters3D(100.0, name, (Marker("1", "knee"),))))


def channels(*labels: str, version: int = 1, source: str = "lab") -> Message:
    described = tuple(AnalogChannel(str(n), label) for n, label in enumerate(labels))
    return parameters(Parameters(analog=ParametersAnalog(described)), version, source=source)


def plate(force_unit: str = "N", moment_unit: str = "Nm", corners: tuple[Point, ...] | None = None) -> Plate:
    """Return a plate of 600 × 400 mm with its centre at 1300, 200 and 50 mm."""
    if corners is None:
        xy = ((1600.0, 400.0), (1000.0, 400.0), (1000.0, 0.0), (1600.0, 0.0))
        corners = tuple(Point(x, y, 50.0, "mm") for x, y in xy)
    units = (force_unit,) * 3 + (moment_unit,) * 3
    return Plate("1", "left", corners=corners, channels=tuple(ForceChannel("1", "", name) for name in units))


def plates(*described: Plate, version: int = 1) -> Message:
    return parameters(Parameters(force=ParametersForce(described)), version)


@pytest.mark.takes
def test_every_value_of_a_real_recording_is_exported(tmp_path: Path) -> None:
    scene = C3dScene(Path(os.environ["RTC3D_TAKES"]) / "qualisys.c3d")
    messages = [description(), parameters(scene.parameters), *scene_messages(scene, scene.num_frames or 0)]
    content = export(tmp_path, messages, notes=[one_of(20)])
    assert_equals_take(content, tmp_path / "take.lcmlog", arrow_interval=20)
    assert len(content.topics["/lab/markers"]) == scene.num_frames


def test_every_value_of_a_computed_scene_is_exported(tmp_path: Path) -> None:
    messages = [
        description(),
        details("S01"),
        parameters(SCENE.parameters),
        *scene_messages(SCENE, 50),
    ]
    content = export(tmp_path, messages, notes=[one_of(10)])
    assert_equals_take(content, tmp_path / "take.lcmlog", arrow_interval=10)
    assert content.schemas == {
        "/lab/markers": "foxglove.PointCloud",
        "/lab/tools": "foxglove.FrameTransforms",
        "/lab/analog": "rtc3d.lab.Analog",
        "/lab/loads": "rtc3d.lab.Loads",
        "/lab/forces": "foxglove.SceneUpdate",
        "/lab/plates": "foxglove.SceneUpdate",
        "/lab/parameters": "rtc3d.Parameters",
    }
    facts = {"server": "192.0.2.20:3020", "gateway_version": "1.0", "subject": "S01"}
    assert content.metadata == {"lab": facts}
    [attachment] = content.attachments
    assert (attachment.name, attachment.media_type) == ("lab-parameters-1.xml", "application/xml")
    assert attachment.data == encode_parameters(SCENE.parameters)


@pytest.mark.parametrize(("name", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("", 1e-3)])
def test_markers_are_in_metres_without_missing_ones(tmp_path: Path, name: str, metres: float) -> None:
    rows: list[list[tuple[Any, ...]]] = [
        [(1, 2, 3, 0.5), NO_MARKER, (-4, 5, math.nan, 1), (7, 8, 9, 2)],
        [NO_MARKER],
    ]
    messages = [frame(ComponentType.MARKERS, row, number) for number, row in enumerate(rows)]
    logged = export(tmp_path, [unit(name), *messages]).topics["/lab/markers"]
    points = points_of(logged[0].content)
    assert [tuple(point) for point in points.tolist()] == [
        (*(pytest.approx(x * metres) for x in (1, 2, 3)), 0.5, 0),
        (*(pytest.approx(x * metres) for x in (7, 8, 9)), 2.0, 3),
    ]
    assert len(points_of(logged[1].content)) == 0
    cloud = logged[1].content
    assert (cloud.frame_id, cloud.pose.orientation.w) == ("lab", 1.0)
    time_ns = (START_UTIME + 10_000 - 2000) * 1000  # capture_utime
    assert (logged[1].time_ns, cloud.timestamp.ToNanoseconds()) == (time_ns, time_ns)


def test_a_converted_or_unknown_unit_is_reported(tmp_path: Path) -> None:
    for name, expected in (("mm", ["positions converted from mm to m"]), ("m", [])):
        job = export_messages(tmp_path, [unit(name), markers(1)], f"{name}.mcap")
        assert [note for note in notes_of(job, usual=True) if "positions" in note] == expected
    job = export_messages(tmp_path, [unit("furlong"), markers(1)], "walk.mcap")
    assert each_names(notes_of(job), ["lab", "'furlong'", "mm"])


def test_visible_tools_are_transforms_from_the_source_to_their_labels(tmp_path: Path) -> None:
    described = Parameters(
        markers=Parameters3D(100.0, "cm"),
        tools=Parameters6D(100.0, tuple(Tool("1", x) for x in ("cup", "a b"))),
    )
    messages = [
        frame(ComponentType.TOOLS, [(0.5, 0.5, -0.5, 0.5, 100, 200, 300, 0.1), (0, 0, 0, 0, 1, 2, 3, 0)]),
        frame(ComponentType.TOOLS, [NO_TOOL, NO_TOOL], 1),
        frame(ComponentType.TOOLS, [NO_TOOL, (1, 0, 0, 0, 4, 5, 6, 0), (1, 0, 0, 0, 7, 8, 9, 0)], 2),
    ]
    content = export(tmp_path, [parameters(described), *messages], notes=["rows of 6d of lab"])
    first, last = content.topics["/lab/tools"]
    [cup] = first.content.transforms
    assert (cup.parent_frame_id, cup.child_frame_id) == ("lab", "lab/cup")
    assert (cup.translation.x, cup.translation.y, cup.translation.z) == (1.0, 2.0, 3.0)
    assert (cup.rotation.x, cup.rotation.y, cup.rotation.z, cup.rotation.w) == (0.5, -0.5, 0.5, 0.5)
    assert cup.timestamp.ToNanoseconds() == first.time_ns == (START_UTIME - 2000) * 1000
    assert [found.child_frame_id for found in last.content.transforms] == ["lab/a b", "lab/tool 3"]


def test_a_force_is_an_arrow_at_the_centre_of_pressure(tmp_path: Path) -> None:
    # The force acts 0.1 m beside the centre in x and -0.05 m in y: M = r × F, and a torque about z.
    force = np.array([30.0, -40.0, 500.0])
    moment = np.cross([0.1, -0.05, 0.0], force) + np.array([0, 0, 7.0])
    messages = [
        frame(ComponentType.FORCE, [(*force, *moment)]),
        frame(ComponentType.FORCE, [(0, 0, 5, 1, 1, 0)], 1),
        frame(ComponentType.FORCE, [(math.nan,) * 6], 2),
    ]
    content = export(tmp_path, [plates(plate()), *messages])
    on, off, unknown = content.topics["/lab/forces"]
    [entity] = on.content.entities
    assert (entity.id, entity.frame_id, entity.lifetime.seconds) == ("left", "lab", 1)
    [arrow] = entity.arrows
    position = arrow.pose.position
    assert (position.x, position.y, position.z) == pytest.approx((1.4, 0.15, 0.05))
    length = np.linalg.norm(force)
    assert arrow.shaft_length + arrow.head_length == pytest.approx(length / 1000)
    assert rotated(arrow.pose.orientation, (1, 0, 0)) == pytest.approx(force / length)
    assert [len(entity.arrows) for update in (off, unknown) for entity in update.content.entities] == [0, 0]
    [scene] = content.topics["/lab/plates"]
    [outline] = scene.content.entities
    corners = [(point.x, point.y, point.z) for point in outline.lines[0].points]
    assert corners == [(1.6, 0.4, 0.05), (1.0, 0.4, 0.05), (1.0, 0.0, 0.05), (1.6, 0.0, 0.05)]
    assert outline.texts[0].text == "left"
    assert [deletion.type for deletion in scene.content.deletions] == [1]  # all
    loads = floats_of(content.topics["/lab/loads"][0].content)
    assert list(loads) == [f"left_{name}" for name in ("fx", "fy", "fz", "mx", "my", "mz")]
    assert list(loads.values()) == pytest.approx([*force, *moment])


@pytest.mark.parametrize(
    ("units", "factors"),
    [
        (("kN", "Nm"), (1e-3, 1.0)),
        (("N", "Nmm"), (1.0, 1e3)),
        (("n", "N.mm"), (1.0, 1e3)),
        (("kN", "kNm"), (1e-3, 1e-3)),
    ],
)
@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (-1, 0, 0.03), (0, 1, 1)])
def test_arrows_know_the_units_of_forces_and_moments(
    tmp_path: Path,
    units: tuple[str, str],
    factors: tuple[float, float],
    direction: tuple[float, float, float],
) -> None:
    force = np.array(direction) * 1000
    moment = np.cross([-0.2, 0.1, 0.0], force)
    message = frame(ComponentType.FORCE, [(*force * factors[0], *moment * factors[1])])
    content = export(tmp_path, [plates(plate(*units)), message])
    [arrow] = content.topics["/lab/forces"][0].content.entities[0].arrows
    assert (arrow.pose.position.x, arrow.pose.position.y) == pytest.approx((1.1, 0.3), abs=1e-5)
    assert arrow.shaft_length + arrow.head_length == pytest.approx(np.linalg.norm(force) / 1000)
    turned = rotated(arrow.pose.orientation, (1, 0, 0))
    assert turned == pytest.approx(force / np.linalg.norm(force), abs=1e-6)


def test_a_plate_whose_place_is_not_known_has_numbers_but_no_arrow(tmp_path: Path) -> None:
    unknown = plate(corners=(Point(), Point(), Point(), Point()))
    loads = [(1, 2, 300, 4, 5, 6)] * 3
    messages = [plates(unknown, plate()), frame(ComponentType.FORCE, loads)]
    content = export(tmp_path, messages)
    assert [entity.id for entity in content.topics["/lab/forces"][0].content.entities] == ["left_2"]
    assert list(floats_of(content.topics["/lab/loads"][0].content).values()) == [1, 2, 300, 4, 5, 6] * 3


def test_plates_that_are_renamed_replace_the_earlier_ones(tmp_path: Path) -> None:
    load = [(0, 0, 100, 0, 0, 0)]
    messages = [plates(plate()), frame(ComponentType.FORCE, load), plates(version=2)]
    messages += [frame(ComponentType.FORCE, load, number, version=2) for number in (1, 2)]
    content = export(tmp_path, messages)
    first, second = content.topics["/lab/plates"]
    assert [len(update.content.entities) for update in (first, second)] == [1, 0]
    assert second.time_ns == content.topics["/lab/forces"][1].time_ns
    assert [entry.content["version"] for entry in content.topics["/lab/parameters"]] == [1, 2]
    names = [attachment.name for attachment in content.attachments]
    assert names == ["lab-parameters-1.xml", "lab-parameters-2.xml"]


def test_events_are_logged_with_their_labels_and_parameters(tmp_path: Path) -> None:
    switch = EventParameter("2", "int", "state", (ExpectedValue("1", "1", "ON"),))
    definition = EventDefinition("0x10", "Button", parameters=(EventParameter("1", "int", "number"), switch))
    described = Parameters(events=ParametersEvents((definition,)))
    items = [(16, 8_999_000, 3, 1, -1), (7, 0, -1, -1, -1)]
    messages = [
        parameters(described),
        frame(ComponentType.EVENT, items, timestamp_us=9_000_000),
        frame(ComponentType.EVENT, [(16, 5_000_000, 4, 0, -1)], 1, timestamp_us=9_000_000),
        frame(ComponentType.EVENT, [], 2),
    ]
    logs = export(tmp_path, messages).topics["/lab/events"]
    expected = ["Button (number: 3; state: ON)", "event 7", "Button (number: 4; state: 0)"]
    assert [log.content.message for log in logs] == expected
    captured_ns = (START_UTIME - 2000) * 1000
    # The first is 1 ms older than its frame; the others have no plausible time stamp.
    assert [log.time_ns for log in logs] == [captured_ns - 1_000_000, captured_ns, captured_ns + 10_000_000]
    assert [log.content.timestamp.ToNanoseconds() for log in logs] == [log.time_ns for log in logs]
    assert {(log.content.name, log.content.level) for log in logs} == {("lab", 2)}


def test_analog_channels_have_their_labels_as_names(tmp_path: Path) -> None:
    labels = ("EMG 1", "EMG_1", "EMG1", "emg1", "Füße", "力", "1st", "a.b", "EMG 1", "")
    values = [0.1 * number for number in range(10)]
    messages = [channels(*labels), frame(ComponentType.ANALOG, [*values, 7.0])]
    content = export(tmp_path, messages)
    found = floats_of(content.topics["/lab/analog"][0].content)
    assert list(found) == [
        *("EMG_1", "EMG_1_2", "EMG1", "emg1", "Fu_e", "channel_6", "_1st", "a_b", "EMG_1_2_2"),
        *("channel_10", "channel_11"),
    ]
    assert list(found.values()) == pytest.approx([*values, 7.0])
    described = content.topics["/lab/parameters"][0].content["analog"]
    assert described["labels"][4:7] == ["Füße", "力", "1st"]
    assert described["fields"] == list(found)[:10]
    assert set(described["units"]) == {"mV"}


def test_labels_that_cannot_be_names_are_reported(tmp_path: Path) -> None:
    for label, is_changed in (("EMG 1", True), ("EMG1", False)):
        messages = [channels(label), frame(ComponentType.ANALOG, [1.0])]
        job = export_messages(tmp_path, messages, f"{label}.mcap")
        notes = notes_of(job, usual=True)
        assert one_names(notes, "labels of channels", "EMG_1") == is_changed
        assert not any("positions" in note for note in notes)


def test_other_labels_get_another_topic_because_viewers_decode_a_topic_in_one_way(tmp_path: Path) -> None:
    messages = []
    for source in ("lab", "lab-2"):
        messages += [channels("a", "b", source=source), channels("x", "b", version=2, source=source)]
        messages += [
            frame(ComponentType.ANALOG, [1, 2], number, version=version, source=source)
            for number, version in enumerate([1, 1, 2, 2, 1])
        ]
    content = export(tmp_path, [description(), description("lab-2"), *messages])
    for source, package in (("lab", "lab"), ("lab-2", "lab_2")):
        for end, expected in (("", [{"a": 1, "b": 2}] * 3), ("_2", [{"x": 1, "b": 2}] * 2)):
            topic = f"/{source}/analog{end}"
            assert [floats_of(log.content) for log in content.topics[topic]] == expected
            assert content.schemas[topic] == f"rtc3d.{package}.Analog{end}"


def test_frames_with_very_many_channels_are_left_out_and_reported(tmp_path: Path) -> None:
    values = np.arange(10_001).tolist()
    messages = [frame(ComponentType.ANALOG, values[1:]), frame(ComponentType.ANALOG, values, 1)]
    job = export_messages(tmp_path, messages, "walk.mcap")
    assert each_names(
        notes_of(job)[1:], ["10000 numbers", "analog", "lab", 1], ["rows", "analog", "lab", "1 of 2"]
    )
    [log] = read_mcap(tmp_path / "walk.mcap").topics["/lab/analog"]
    assert list(floats_of(log.content).values()) == values[1:]


def test_labels_that_change_all_the_time_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.takes.export.mcap_file._MAX_CHANNELS", 50)
    messages = [frame(ComponentType.ANALOG, [0.0] * number, number) for number in range(1, 60)]
    with raises(TakeError, "labels"):
        export_messages(tmp_path, messages, "walk.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]


def test_only_the_chosen_time_and_source_are_exported(tmp_path: Path) -> None:
    messages = [message for source in ("lab", "b") for message in (description(source), unit("mm"))]
    messages += [markers(1, number, source=source) for number in range(100) for source in ("lab", "b")]
    messages.insert(50, parameters(SCENE.parameters, 2))
    content = export(tmp_path, messages, part=TakePart("lab", 0.2, 0.6))
    assert set(content.topics) == {"/lab/markers", "/lab/plates", "/lab/parameters"}
    logged = content.topics["/lab/markers"]
    assert [points_of(log.content)["y"][0] * 1000 for log in logged] == pytest.approx(range(20, 60))
    assert content.topics["/lab/plates"][0].time_ns == logged[0].time_ns
    assert set(content.metadata) == {"lab"}


def test_what_cannot_be_exported_is_reported(tmp_path: Path) -> None:
    channel, message = markers(2, 3)
    truncated = message[:-1]
    too_many = message[:52] + struct.pack(">i", -1) + message[56:]
    early = message[:16] + struct.pack(">q", -1) + message[24:]
    late = message[:16] + struct.pack(">q", 1 << 62) + message[24:]
    other = (lcm_channel("MOCAP", "lab", "other"), b"something else")
    damaged = [(channel, data) for data in (truncated, too_many, message[:20], early, late)]
    damaged.append((unit("mm")[0], unit("mm")[1][:-1]))
    job = export_messages(tmp_path, [unit("mm"), markers(2), *damaged, other], "walk.mcap")
    assert each_names(
        sorted(notes_of(job)),
        ["malformed", "3d", "lab", 3],
        ["malformed", "parameters", "lab", 1],
        ["1970", "2106", "3d", "lab", 2],
        ["MOCAP_LAB_OTHER", 1],
        ["rows", "3d", "lab", "2 of 3"],
    )
    assert len(read_mcap(tmp_path / "walk.mcap").topics["/lab/markers"]) == 1


def test_versions_that_start_again_have_the_newest_parameters_before_the_message(tmp_path: Path) -> None:
    late = START_UTIME + 1_000_000
    new = Parameters(analog=ParametersAnalog((AnalogChannel("0", "new"),)))
    messages = [channels("old"), frame(ComponentType.ANALOG, [1]), parameters(new, utime=late)]
    messages.append(frame(ComponentType.ANALOG, [2], 1, utime=late + 1))
    messages.append(frame(ComponentType.ANALOG, [3], 2, version=5, utime=late + 2))
    content = export(tmp_path, messages)
    analog = (logs for topic, logs in content.topics.items() if "analog" in topic)
    found = [floats_of(log.content) for logs in analog for log in logs]
    assert found == [{"old": 1}, {"new": 2}, {"channel_1": 3}]


def test_without_foxglove_sdk_the_error_has_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [name for name in sys.modules if name.startswith("gateway.takes.export.mcap")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "gateway.messages.foxglove.topics", None)
    with raises(TakeError, "'rtc3d-gateway[foxglove]'"):
        export_messages(tmp_path, [markers(1)], "walk.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]


def test_a_full_disk_is_its_own_error_whatever_is_written() -> None:
    topic = FoxgloveTopic("/lab/test", "json", "test", "jsonschema", b"{}")
    messages = TopicMessages(topic, [START_UTIME], [os.urandom(2_000_000)])
    entry = ParametersEntry(START_UTIME, 1, Parameters(), bytes(2_000_000))

    uses: list[Callable[[McapFile], object]] = [
        lambda file: file.add(messages),
        lambda file: file.describe(TakeSource("lab", parameters=[entry])),
        lambda file: file.describe(TakeSource("lab", "192.0.2.20:3020")),
        lambda _file: None,
    ]
    for use in uses:
        with (
            Path("/dev/full").open("wb", buffering=0) as full,
            pytest.raises(OSError, match="No space left on device"),
            McapFile(full) as file,
        ):
            use(file)
