"""In which frame exported coordinates are: those of the server, except in bags of ROS 2."""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from gateway.rtc3d.parameters import Plate
from gateway.takes.export.job import BidsNames, ExportJob
from gateway.takes.export.registry import CHOSEN_FORMATS, FORMATS
from tests.support.errors import one_names
from tests.support.takes import Message
from tests.unit.takes.export.exported import C3d, export_messages, notes_of, scene
from tests.unit.takes.export.test_c3d import CORNERS, plate_messages
from tests.unit.takes.export.test_rosbag import status as status_of

WITH_COORDINATES: Final = [".c3d", ".trc", ".mot", ".csv", ".parquet", ".mcap", "opensim", "bids"]
NO_ROTATION: Final = (0.0, 0.0, 0.0, 1.0)
TURNED: Final = (0.0, 0.0, 0.6, 0.8)


def status(
    frame_id: str, metres: float, rotation: tuple[float, ...] = NO_ROTATION, *, is_moved: bool = False
) -> Message:
    return status_of(frame_id, rotation, metres, (1.0, 2.0, 3.0) if is_moved else (0.0, 0.0, 0.0))


def export(folder: Path, name: str, *messages: Message) -> ExportJob:
    chosen: dict[str, Any] = {"format": name} if name in CHOSEN_FORMATS else {}
    options = {"bids": BidsNames("walking"), "details": {"subject": "01"}}
    out = "out" if name in {"opensim", "bids"} else "out.mcap" if chosen else f"out{name}"
    return export_messages(folder, [*messages, *scene(20)], out, **chosen, **options)


TRANSFORMS: Final = {
    "turned": status("world", 1e-3, TURNED),
    "moved": status("world", 1e-3, is_moved=True),
    "scaled": status("world", 2e-3),
}


@pytest.mark.parametrize("name", WITH_COORDINATES)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_table_of_changes_says_that_the_transform_is_not_applied(
    tmp_path: Path, name: str, transform: str
) -> None:
    """The newest status counts, and a scale alone is a transform, too."""
    job = export(tmp_path, name, status("old", 1e-3), TRANSFORMS[transform])
    assert one_names(notes_of(job), "lab", "transform", "world", "not applied")
    assert not any("old" in note for note in notes_of(job))


@pytest.mark.parametrize("name", WITH_COORDINATES)
def test_the_table_of_changes_names_a_frame_that_somebody_has_chosen(tmp_path: Path, name: str) -> None:
    job = export(tmp_path, name, status("world", 1e-3))
    assert one_names(notes_of(job), "lab", "frame world")


@pytest.mark.parametrize("name", [*FORMATS, *CHOSEN_FORMATS])
def test_nothing_is_reported_if_the_frame_is_that_of_the_server(tmp_path: Path, name: str) -> None:
    assert not any("frame lab" in note for note in notes_of(export(tmp_path, name, status("lab", 1e-3))))


@pytest.mark.parametrize("name", [".c3d", ".mot", "opensim"])
def test_plates_whose_forces_come_from_channels_have_a_frame(tmp_path: Path, name: str) -> None:
    """A server need not send the component Force: the corners of the plates are in its coordinates."""
    plate = Plate("1", corners=CORNERS, analog_channel_ids=tuple("123456"))
    messages = plate_messages(plate, np.full((20, 6), 30.0), np.zeros((20, 6)))
    messages = [message for message in messages if not message[0].endswith("_FORCE")]
    options: dict[str, Any] = {} if name.startswith(".") else {"format": name}
    job = export_messages(tmp_path, [TRANSFORMS["turned"], *messages], f"out{name}", **options)
    assert one_names(notes_of(job), "lab", "transform", "world", "not applied")


def test_channels_alone_have_no_frame(tmp_path: Path) -> None:
    assert not any("world" in note for note in notes_of(export(tmp_path, ".sto", TRANSFORMS["turned"])))


def test_a_bag_has_the_transform_applied(tmp_path: Path) -> None:
    assert not any("not applied" in note for note in notes_of(export(tmp_path, "ros2", TRANSFORMS["turned"])))


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (status("world", 2e-3, TURNED, is_moved=True), ("world", 2.0, TURNED, (1.0, 2.0, 3.0))),
        (status("lab", 1e-3), ("lab", 1.0, NO_ROTATION, (0.0, 0.0, 0.0))),
    ],
)
def test_a_c3d_file_has_what_brings_its_coordinates_into_the_frame(
    tmp_path: Path, message: Message, expected: tuple[Any, ...]
) -> None:
    export(tmp_path, ".c3d", message)
    found = C3d(tmp_path / "out.c3d")
    frame_id, scale, rotation, translation = expected
    assert [*found("TRIAL", "FRAME_ID")] == [frame_id]
    assert [*found("TRIAL", "FRAME_SCALE")] == [scale]
    assert [*found("TRIAL", "FRAME_ROTATION")] == pytest.approx(rotation)
    assert [*found("TRIAL", "FRAME_TRANSLATION")] == [*translation]


def test_the_coordinates_of_a_c3d_file_are_those_of_the_server(tmp_path: Path) -> None:
    for name, messages in (("plain", []), ("turned", [TRANSFORMS["turned"]])):
        (tmp_path / name).mkdir()
        export(tmp_path / name, ".c3d", *messages)
    plain, turned = (C3d(tmp_path / name / "out.c3d") for name in ("plain", "turned"))
    assert plain.points.tobytes() == turned.points.tobytes()
    assert [*plain("TRIAL", "FRAME_ID")] == []


def bids_description(folder: Path, component: str) -> str:
    [path] = folder.rglob(f"*lab{component}*_channels.json")
    return str(json.loads(path.read_text())["reference_frame"]["Levels"]["lab"]["Description"])


@pytest.mark.parametrize("component", ["Markers", "Forces"])
def test_a_bids_data_set_describes_the_frame(tmp_path: Path, component: str) -> None:
    export(tmp_path, "bids", status("world", 2e-3, TURNED, is_moved=True))
    text = bids_description(tmp_path, component)
    for part in ("frame world", "not applied", "scale by 2", "(0, 0, 0.6, 0.8)", "(1, 2, 3) m"):
        assert part in text


def test_a_bids_data_set_names_the_frame_of_the_server(tmp_path: Path) -> None:
    export(tmp_path, "bids", status("lab", 1e-3))
    text = bids_description(tmp_path, "Markers")
    assert "frame lab" in text
    assert "not applied" not in text
