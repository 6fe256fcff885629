import errno
import logging
import os
import struct
import sys
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters3D, Point
from gateway.session.c3d_files.receiving import parameter_places
from gateway.simulator import c3d_scene
from gateway.simulator.c3d_recording import _markers
from gateway.simulator.c3d_scene import C3dScene
from tests.support.errors import names, raises
from tests.support.records import levels

MISSING = b"\xff" * 12 + bytes.fromhex("4479C000")  # X, Y, Z all ones; 999.0


def new_recording() -> Any:
    """Return five frames of two markers at 100 Hz, and six channels of a plate and one more at 1000 Hz."""
    content = ezc3d.c3d()
    point, analog = content["parameters"]["POINT"], content["parameters"]["ANALOG"]
    point["RATE"]["value"], point["LABELS"]["value"], point["UNITS"]["value"] = [100], ["heel", "toe"], ["mm"]
    analog["RATE"]["value"] = [1000]
    analog["LABELS"]["value"] = ["EMG", "FX", "FY", "FZ", "MX", "MY", "MZ"]
    analog["UNITS"]["value"] = ["mV", "N", "N", "N", "Nmm", "Nmm", "Nmm"]
    plate = content["parameters"]["FORCE_PLATFORM"]
    plate["USED"]["value"], plate["TYPE"]["value"] = np.array([1]), np.array([2])
    plate["CORNERS"]["value"] = np.array([(400.0, 600, 0), (400, 0, 0), (0, 0, 0), (0, 600, 0)]).T[..., None]
    plate["ORIGIN"]["value"] = np.array([(1.0, 2.0, -30.0)]).T
    plate["CHANNEL"]["value"] = np.array([(2, 3, 4, 5, 6, 7)]).T
    plate["ZERO"]["value"] = np.array([0, 0])
    rng = np.random.default_rng(7)
    points = np.ones((4, 2, 5))
    points[:3] = rng.uniform(-1000, 1000, (3, 2, 5))
    points[0, 0, 1] = np.nan
    residuals = rng.uniform(0, 2, (1, 2, 5))
    residuals[0, 1, 3] = -1
    content["data"]["points"] = points
    content["data"]["meta_points"]["residuals"] = residuals
    content["data"]["meta_points"]["camera_masks"] = np.zeros((7, 2, 5), bool)
    content["data"]["analogs"] = rng.uniform(-500, 500, (1, 7, 50))
    return content


def written(content: Any, folder: Path) -> Path:
    path = folder / "take.c3d"
    content.write(str(path))
    return path


@pytest.fixture(autouse=True)
def no_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, each file would take long to read, with a warning."""
    monkeypatch.setattr(c3d_scene, "_NOTICE_S", 3600.0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return written(new_recording(), tmp_path)


def assert_equals_ezc3d(path: Path) -> None:
    """Compare every value of the take with what ezc3d reads, as float32, in the file's order."""
    take = C3dScene(path)
    read = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]
    points, residuals = read["points"][:3], read["meta_points"]["residuals"]
    if points.size:
        markers = take.items(ComponentType.MARKERS, np.arange(points.shape[2]))
        missing = np.isnan(points).any(axis=0).T | (residuals[0].T == -1)
        assert {item.tobytes() for item in markers[missing]} <= {MISSING}
        for name, expected in zip(("x", "y", "z", "reliability"), (*points, residuals[0]), strict=True):
            assert np.array_equal(markers[name][~missing], expected.T[~missing].astype(np.float32))
    if read["analogs"].size:
        analog = take.items(ComponentType.ANALOG, np.arange(read["analogs"].shape[2]))
        assert np.array_equal(analog, read["analogs"][0].T.astype(np.float32))
    for number, plate in enumerate(read["platform"]):
        items = take.items(ComponentType.FORCE, np.arange(plate["force"].shape[1]))[:, [number]]
        expected = np.concatenate([plate["force"], plate["moment"]]).T.astype(np.float32)
        assert np.array_equal(items.view(">f4").reshape(-1, 6), expected)


def test_values_equal_what_ezc3d_reads(path: Path) -> None:
    assert_equals_ezc3d(path)


def test_a_marker_of_nan_or_of_residual_minus_one_is_missing(path: Path) -> None:
    markers = C3dScene(path).items(ComponentType.MARKERS, np.arange(5))
    missing = {(f, m) for f in range(5) for m in range(2) if markers[f, m].tobytes() == MISSING}
    assert (missing, np.isnan(markers["x"]).sum()) == ({(1, 0), (3, 1)}, 2)
    [items] = _markers(np.ones((4, 2, 1)), np.array([[[0.5], [-1.0]]]))
    assert [item.tobytes() for item in items] == [bytes.fromhex("3F800000" * 3 + "3F000000"), MISSING]


def test_each_component_has_its_own_rate_and_repeats_after_its_last_sample(path: Path) -> None:
    take = C3dScene(path)
    rates_hz = {ComponentType.MARKERS: 100.0, ComponentType.ANALOG: 1000.0, ComponentType.FORCE: 1000.0}
    assert (take.rates_hz, take.measurement_rate_hz, take.num_frames) == (rates_hz, 100.0, 5)
    assert len(take.events(0, 10**9)) == 0
    for component, rate_hz in rates_hz.items():
        once = np.arange(round(rate_hz * 0.05))
        later = take.items(component, once + 7 * len(once))
        assert take.items(component, once).tobytes() == later.tobytes()


def test_parameters_are_those_of_the_file(path: Path) -> None:
    """Clients show labels and units, and compute with the corners of plates."""
    described = C3dScene(path).parameters
    assert described.markers == Parameters3D(100.0, "mm", (Marker("1", "heel"), Marker("2", "toe")))
    assert described.analog is not None
    channels = [(each.label, each.unit, each.frequency_hz) for each in described.analog.channels[:2]]
    assert channels == [("EMG", "mV", 1000.0), ("FX", "N", 1000.0)]
    assert described.force is not None
    [plate] = described.force.plates
    corners = [(corner.x, corner.y, corner.z) for corner in plate.corners]
    assert corners == [(400, 600, 0), (400, 0, 0), (0, 0, 0), (0, 600, 0)]
    assert plate.origin == Point(1.0, 2.0, -30.0, "mm")
    assert (plate.analog_channel_ids, plate.frequency_hz) == (("2", "3", "4", "5", "6", "7"), 1000.0)
    assert [channel.unit for channel in plate.channels] == ["N", "N", "N", "Nmm", "Nmm", "Nmm"]


def test_units_that_a_file_lacks_are_not_invented(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Field note 28: one unit for many channels. Points are in mm in nearly all files."""
    content = new_recording()
    content["parameters"]["POINT"]["UNITS"]["value"] = []
    content["parameters"]["ANALOG"]["UNITS"]["value"] = [
        "V"
    ] * 7  # ezc3d would add empty ones to a single one
    path = written(content, tmp_path)
    seven, one = b"\xff\2\1\7VVVVVVV\0", b"\xff\2\1\1V\6      "  # the spaces are a description
    path.write_bytes(path.read_bytes().replace(seven, one))
    parameters = C3dScene(path).parameters
    assert parameters.markers is not None
    assert parameters.analog is not None
    assert parameters.force is not None
    assert [channel.unit for channel in parameters.analog.channels] == ["V"] + [""] * 6
    [plate] = parameters.force.plates
    found = [parameters.markers.unit, plate.corners[0].unit, plate.channels[5].unit]
    assert found == ["mm", "mm", "Nmm"]
    assert levels(caplog) == ["WARNING"] * 2
    assert names(caplog.text, "6 of its 7", "mm")


def test_a_unit_cut_to_four_characters_is_whole_and_markers_without_labels_are_numbered(
    tmp_path: Path,
) -> None:
    content = new_recording()
    content["parameters"]["POINT"]["UNITS"]["value"] = ["mete"]
    content["parameters"]["POINT"]["LABELS"]["value"] = ["heel", ""]
    markers = C3dScene(written(content, tmp_path)).parameters.markers
    assert markers == Parameters3D(100.0, "m", (Marker("1", "heel"), Marker("2", "Marker 2")))


def test_a_recording_without_markers_plays_at_its_analog_rate(tmp_path: Path) -> None:
    content = new_recording()
    del content["parameters"]["POINT"]["LABELS"]["value"][:]
    content["data"]["points"] = np.zeros((4, 0, 5))
    content["data"]["meta_points"]["residuals"] = np.zeros((1, 0, 5))
    content["data"]["meta_points"]["camera_masks"] = np.zeros((7, 0, 5), bool)
    take = C3dScene(written(content, tmp_path))
    assert ComponentType.MARKERS not in take.rates_hz
    assert (take.measurement_rate_hz, take.num_frames) == (1000.0, 50)


def test_unknown_types_of_force_plates_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = new_recording()
    content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"] = [77]
    path = written(content, tmp_path)
    with caplog.at_level(logging.WARNING):
        take = C3dScene(path)
    assert set(take.rates_hz) == {ComponentType.MARKERS, ComponentType.ANALOG}
    assert str(path) in caplog.text
    assert "force plates" in caplog.text


def test_the_group_event_is_played_at_its_times_in_each_pass(tmp_path: Path) -> None:
    """Times count from frame 1 of the trial, and this file begins with frame 101, after 1 s."""
    content = new_recording()
    for name, values in (
        ("USED", [3]),
        ("LABELS", ["Foot Strike", "Foot Off"]),
        ("LABELS2", ["Foot Strike"]),
        ("CONTEXTS", ["Right", "Left"]),
        ("CONTEXTS2", ["Left"]),
    ):
        content.add_parameter("EVENT", name, values)
    content.add_parameter("EVENT", "TIMES", np.array([[0.0, 0.0], [1.03, 1.02]]))
    content.add_parameter("EVENT", "TIMES2", np.array([[0.0], [1.0]]))
    content.add_parameter("TRIAL", "ACTUAL_START_FIELD", [101, 0])
    take = C3dScene(written(content, tmp_path))
    assert take.parameters.events is not None
    labels = {int(each.id): each.label for each in take.parameters.events.events}
    [context] = take.parameters.events.events[0].parameters
    sides = {int(each.value): each.label for each in context.expected_values}
    events = take.events(20_000, 80_001)
    found = [
        (each["timestamp"], labels[each["id"]], sides[each["param1"]], each["param2"]) for each in events
    ]
    assert context.description == "Context"
    assert found == [
        (20_000, "Foot Off", "Left", -1),
        (30_000, "Foot Strike", "Right", -1),
        (50_000, "Foot Strike", "Left", -1),
        (70_000, "Foot Off", "Left", -1),
        (80_000, "Foot Strike", "Right", -1),
    ]


def test_events_of_the_header_are_played_if_there_is_no_group(path: Path) -> None:
    whole = bytearray(path.read_bytes())
    struct.pack_into("<HH2x2f", whole, 149 * 2, 0x3039, 2, 0.04, 0.01)
    whole[198 * 2 : 198 * 2 + 8] = b"LHS RTO "
    path.write_bytes(whole)
    take = C3dScene(path)
    assert take.parameters.events is not None
    labels = {int(each.id): each.label for each in take.parameters.events.events}
    events = take.events(0, 50_000)
    assert [(each["timestamp"], labels[each["id"]]) for each in events] == [(10_000, "RTO"), (40_000, "LHS")]


def changed(path: Path, **numbers: float) -> Path:
    """Change what a file states: fields of the header, or parameters such as ANALOG_RATE."""
    whole = bytearray(path.read_bytes())
    header = {"points": (2, "H"), "analog": (4, "H"), "first": (6, "H"), "last": (8, "H"), "scale": (12, "f")}
    header |= {"samples": (18, "H"), "rate": (20, "f")}
    places = {
        name.replace(":", "_"): (at, size)
        for name, size, at, _ in parameter_places(bytes(whole), 512 + 4, "<")
    }
    for name, number in numbers.items():
        at, kind = header[name] if name in header else (places[name][0], {2: "H", 4: "f"}[places[name][1]])
        struct.pack_into(f"<{kind}", whole, at, number)
    path.write_bytes(whole)
    return path


def content_of(scene: C3dScene) -> list[Any]:
    """Return all that is played of a file, as bytes, and its rates."""
    found: list[Any] = [scene.rates_hz, scene.num_frames, scene.measurement_rate_hz]
    for component, rate_hz in scene.rates_hz.items():
        samples = round(scene.num_frames * rate_hz / scene.measurement_rate_hz)
        found.append(scene.items(component, np.arange(samples)).tobytes())
    return found


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ANALOG_RATE", 1),
        ("ANALOG_RATE", 0),
        ("ANALOG_RATE", 100),
        ("ANALOG_RATE", 500),
        ("ANALOG_RATE", 999),
        ("ANALOG_RATE", 1100),
        ("POINT_RATE", 50),
        ("POINT_RATE", 200),
        ("POINT_RATE", 0),
        ("POINT_USED", 1),
        ("POINT_USED", 3),
        ("ANALOG_USED", 0),
        ("ANALOG_USED", 6),
        ("ANALOG_USED", 8),
        ("POINT_FRAMES", 3),
        ("POINT_FRAMES", 4),
        ("POINT_SCALE", 0.5),
        ("POINT_SCALE", -2),
    ],
)
def test_what_contradicts_the_header_is_replaced_by_it_with_a_warning(
    path: Path, name: str, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    """ezc3d believes the parameters: it would leave out channels and frames, or read the wrong bytes."""
    expected = content_of(C3dScene(path))
    assert not caplog.records
    assert content_of(C3dScene(changed(path, **{name: value}))) == expected
    [record] = caplog.records
    assert record.levelno == logging.WARNING
    assert name.replace("_", ":") in record.message
    assert str(path) in record.message


@pytest.mark.parametrize("name", ["POINT_LABELS", "ANALOG_LABELS"])
def test_fewer_labels_than_items_are_reported(
    path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Labels are by position, so one that is missing may have moved all others."""
    whole = bytearray(path.read_bytes())
    places = {each[0].replace(":", "_"): each for each in parameter_places(bytes(whole), 512 + 4, "<")}
    _, _, at, num_bytes = places[name]
    last = at + num_bytes * (1 if name == "POINT_LABELS" else 6) // (2 if name == "POINT_LABELS" else 7)
    whole[last : at + num_bytes] = b" " * (at + num_bytes - last)
    path.write_bytes(whole)
    parameters = C3dScene(path).parameters
    assert parameters.markers is not None
    assert parameters.analog is not None
    labels = [each.label for each in parameters.markers.markers]
    labels += [each.label for each in parameters.analog.channels]
    assert ("Marker 2" in labels, "Analog 7" in labels) == (name == "POINT_LABELS", name == "ANALOG_LABELS")
    [record] = caplog.records
    assert name.replace("_", ":") in record.message


def test_one_analog_sample_per_frame_is_played_whatever_the_rate_says(tmp_path: Path) -> None:
    """The file that was found: 100 Hz, one sample per frame, and an ANALOG:RATE of 1 Hz."""
    content = new_recording()
    content["parameters"]["ANALOG"]["RATE"]["value"] = [100]
    content["data"]["analogs"] = content["data"]["analogs"][:, :, :5]
    path = changed(written(content, tmp_path), ANALOG_RATE=1)
    scene = C3dScene(path)
    assert scene.rates_hz[ComponentType.ANALOG] == 100
    assert scene.items(ComponentType.ANALOG, np.arange(5)).shape == (5, 7)


def test_a_rate_that_was_rounded_is_corrected_without_a_word(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """ezc3d would read nine samples per frame instead of ten, and positions from the wrong bytes."""
    expected = content_of(C3dScene(path))
    assert content_of(C3dScene(changed(path, ANALOG_RATE=999.99))) == expected
    assert not caplog.records


@pytest.mark.parametrize(
    "statements",
    [
        {"rate": 0},
        {"samples": 0},
        {"last": 0xFFFF},
        {"last": 0},
        {"scale": 0},
        {"rate": float("nan")},
    ],
)
def test_what_the_header_does_not_say_contradicts_nothing(
    path: Path, statements: dict[str, float], caplog: pytest.LogCaptureFixture
) -> None:
    """Programs leave fields empty, and it cannot count more than 65535 frames."""
    expected = content_of(C3dScene(path))
    assert content_of(C3dScene(changed(path, **statements))) == expected
    assert not caplog.records


@pytest.mark.takes
def test_the_channels_of_a_recording_with_a_wrong_rate_are_played() -> None:
    """The header says one analog sample per frame at 100 Hz, ANALOG:RATE 1 Hz."""
    path = Path(os.environ.get("RTC3D_TAKES") or ".") / "analog_rate_1.c3d"
    if not path.exists():
        pytest.skip("RTC3D_TAKES names no folder with analog_rate_1.c3d")
    scene = C3dScene(path)
    assert scene.items(ComponentType.ANALOG, np.arange(1)).shape == (1, 3)
    assert scene.rates_hz[ComponentType.ANALOG] == 100


def with_events(folder: Path, *seconds: float) -> Path:
    """Write five frames at 100 Hz with events at these times."""
    content = new_recording()
    content.add_parameter("EVENT", "USED", [len(seconds)])
    content.add_parameter("EVENT", "LABELS", [f"at {each}" for each in seconds])
    content.add_parameter("EVENT", "TIMES", np.array([[0.0] * len(seconds), seconds]))
    return written(content, folder)


@pytest.mark.parametrize(
    ("seconds", "played_us", "moved"),
    [
        ((0.01, 0.04), [10_000, 40_000], ""),
        ((0.01, 0.049), [10_000, 40_000], "1 of 2 events"),
        ((0.0, 0.04999), [0, 40_000], "1 of 2 events"),
        ((-0.006, 0.02), [0, 20_000], "1 of 2 events"),
        ((-0.006, 0.046), [0, 40_000], "2 of 2 events"),
        ((0.0400001, 0.0), [0, 40_000], ""),
    ],
)
def test_events_that_move_to_the_first_or_last_frame_are_reported(
    tmp_path: Path,
    seconds: tuple[float, ...],
    played_us: list[int],
    moved: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """An event less than a frame after the last one is played with it, or the pass would end without it."""
    events = C3dScene(with_events(tmp_path, *seconds)).events(0, 50_000)
    assert events["timestamp"].tolist() == played_us
    assert [record.levelname for record in caplog.records] == ["WARNING"] * bool(moved)
    assert moved in caplog.text


def test_events_outside_of_the_frames_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = new_recording()
    content.add_parameter("EVENT", "USED", [2])
    content.add_parameter("EVENT", "LABELS", ["a", "b"])
    content.add_parameter("EVENT", "TIMES", np.array([[1.0, 0.0], [0.0, 0.049]]))
    events = C3dScene(written(content, tmp_path)).events(0, 50_000)
    assert events["timestamp"].tolist() == [40_000]  # with the last frame, so that --once has it, too
    assert "1 of 2 events" in caplog.text


@pytest.mark.parametrize(
    ("content", "problem"),
    [(b"", "C3D"), (b"no C3D file\n" * 999, "C3D"), (None, os.strerror(errno.ENOENT))],
)
def test_the_error_about_an_invalid_file_names_it(path: Path, content: bytes | None, problem: str) -> None:
    """The user may have chosen the wrong file of a folder."""
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with raises(TakeError, path, problem):
        C3dScene(path)
    with raises(TakeError, path.parent, "folder"):
        C3dScene(path.parent)


def test_a_file_cut_short_before_its_data_is_refused_and_one_cut_in_it_plays_up_to_there(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """ezc3d would read beyond the end, and says nothing about frames that are missing."""
    whole = path.read_bytes()
    for length in (1, 100, 511, 512, 600, 1000, 1500):
        path.write_bytes(whole[:length])
        with pytest.raises(TakeError, match=path.name):
            C3dScene(path)
    path.write_bytes(whole[:-600])
    assert C3dScene(path).num_frames == 4
    assert names(caplog.text, "4 of its 5", path)


def test_a_file_with_an_impossible_size_is_refused_before_it_is_read(path: Path) -> None:
    """ezc3d would allocate what the file states."""
    whole = path.read_bytes()
    at = whole.index(b"LABELS", 512) + len("LABELS") + 2  # behind the offset: type, number of sizes, sizes
    for damaged, values in (
        (
            whole[:at] + b"\xff\3\xff\xff\xff" + whole[at + 5 :],
            ["POINT:LABELS", 16581375],
        ),
        (
            whole.replace(struct.pack("<f", 1000.0), struct.pack("<f", 1e6)),
            ["frames"],
        ),
    ):
        path.write_bytes(damaged)
        with raises(TakeError, path, *values):
            C3dScene(path)


@pytest.mark.parametrize(
    ("limit", "value", "problem"),
    [("_MEMORY_BYTES", 200 * 1024**2, "210 MB"), ("_WALL_FACTOR", 0, "0 s")],
)
def test_a_file_that_takes_too_much_is_refused(
    path: Path, limit: str, value: int, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not every damage is visible in the sizes; this file has a rate that would make ezc3d use 28 GB."""
    monkeypatch.setattr(c3d_scene, limit, value)
    monkeypatch.setattr(c3d_scene, "_MEMORY_PER_BYTE", 0)
    monkeypatch.setattr(c3d_scene, "problem_of_sizes", lambda *_: "")
    whole = path.read_bytes()
    path.write_bytes(whole.replace(struct.pack("<f", 1000.0), struct.pack("<f", 1e10)))
    with raises(TakeError, path, problem):
        C3dScene(path)


def test_a_file_whose_process_fails_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with raises(TakeError, path, "status 1"):
        C3dScene(path)


def test_without_ezc3d_the_error_says_how_to_install_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ezc3d", None)  # then importing it raises ImportError
    with raises(TakeError, "'rtc3d-gateway[c3d]'"):
        C3dScene(path)


@pytest.mark.takes
@pytest.mark.parametrize("name", ["qualisys.c3d", "optotrak.c3d"])
def test_real_recordings_equal_what_ezc3d_reads(name: str) -> None:
    folder = os.environ.get("RTC3D_TAKES")
    if not folder:
        pytest.skip("RTC3D_TAKES names no folder with recordings")
    assert_equals_ezc3d(Path(folder) / name)
