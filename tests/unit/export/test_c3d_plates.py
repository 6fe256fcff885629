"""Force plates in exported C3D files, read by ezc3d."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    ForceChannel,
    Parameters,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Point,
)
from tests.recorded_scenes import scene_messages
from tests.takes import Message, frame, parameters
from tests.unit.export.c3d_takes import PLATES, SCENE
from tests.unit.export.exported import export_messages, read_ezc3d

CORNERS = (Point(508, 464, 0), Point(508, 0, 10), Point(0, 0, 10), Point(0, 464, 0))
CALIBRATION = np.diag([100.0, 100, 200, 5000, 5000, 4000]) + 0.3


def test_plates_without_channels_of_their_own_get_six_each(tmp_path: Path) -> None:
    job = export_messages(tmp_path, [parameters(SCENE.parameters), *scene_messages(SCENE, 150)], "out.c3d")
    assert job.notes == []
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["parameters"]["ANALOG"]["LABELS"]["value"][3:] == [
        *("Fx1", "Fy1", "Fz1", "Mx1", "My1", "Mz1"),
        *("Fx2", "Fy2", "Fz2", "Mx2", "My2", "Mz2"),
    ]
    assert content["parameters"]["ANALOG"]["UNITS"]["value"][3:9] == ["N"] * 3 + ["Nmm"] * 3
    recorded = SCENE.items(ComponentType.FORCE, np.arange(1500))
    assert len(content["data"]["platform"]) == 2
    for index, plate in enumerate(content["data"]["platform"]):
        force = np.stack([recorded[name][:, index] for name in ("fx", "fy", "fz")])
        moment_nmm = 1000.0 * np.stack([recorded[name][:, index] for name in ("mx", "my", "mz")])
        assert np.allclose(plate["force"], force, rtol=1e-5, atol=1e-3)
        assert np.allclose(plate["moment"], moment_nmm, rtol=1e-5, atol=1.0)
        loaded = force[2] > 100
        corners = np.array([[corner.x, corner.y] for corner in PLATES[index].corners])
        centre = corners.mean(axis=0)[:, None] + np.stack([-moment_nmm[1], moment_nmm[0]]) / force[2]
        assert np.allclose(plate["center_of_pressure"][:2, loaded], centre[:, loaded], atol=0.1)


def plate_messages(plate: Plate, channels: Any, loads: Any) -> list[Message]:
    """Return a take of a plate's analog channels and of its loads, each (samples, values), at 100 Hz."""
    count = channels.shape[1]
    described = Parameters(
        analog=ParametersAnalog(
            tuple(AnalogChannel(str(n + 1), f"c{n}", frequency_hz=100.0) for n in range(count))
        ),
        force=ParametersForce((replace(plate, frequency_hz=100.0),)),
    )
    messages = [parameters(described)]
    for number, (row, load) in enumerate(zip(channels, loads, strict=True)):
        messages.append(frame(ComponentType.ANALOG, row.tolist(), number))
        messages.append(frame(ComponentType.FORCE, [tuple(load.tolist())], number))
    return messages


@pytest.mark.parametrize("origin", [Point(1.5, -0.8, -34), Point(-1.5, 0.8, 34), None])
@pytest.mark.parametrize(("plate_type", "num_channels"), [(2, 6), (3, 8), (4, 6)])
def test_own_channels_are_used_if_they_give_the_recorded_loads(
    tmp_path: Path, plate_type: int, num_channels: int, origin: Point | None
) -> None:
    channels = np.random.default_rng(2).normal(size=(40, num_channels)) * 30
    plate = Plate(
        "1",
        corners=CORNERS,
        origin=origin,
        channels=tuple(ForceChannel(str(n), unit="N" if n < 3 else "Nmm") for n in range(6)),
        analog_channel_ids=tuple(str(n + 1) for n in range(num_channels)),
        calibration_matrix=tuple(map(tuple, CALIBRATION.tolist())) if plate_type == 4 else (),
    )
    # First let ezc3d compute the loads: without a Force component, the type is taken on trust.
    only_analog = [
        message for message in plate_messages(plate, channels, np.zeros((40, 6))) if "FORCE" not in message[0]
    ]
    export_messages(tmp_path, only_analog, "trusted.c3d")
    (computed,) = read_ezc3d(tmp_path / "trusted.c3d")["data"]["platform"]
    loads = np.concatenate([computed["force"], computed["moment"]]).T
    job = export_messages(tmp_path, plate_messages(plate, channels, loads), "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    group = content["parameters"]["FORCE_PLATFORM"]
    assert group["TYPE"]["value"].tolist() == [plate_type]
    assert group["CHANNEL"]["value"][:, 0].tolist() == list(range(1, num_channels + 1))
    assert content["data"]["analogs"].shape == (1, num_channels, 40)
    assert np.allclose(content["data"]["platform"][0]["force"], computed["force"])
    if plate_type == 4:
        assert np.allclose(group["CAL_MATRIX"]["value"][..., 0], CALIBRATION)
    assert job.notes == []
    # Loads that do not follow from the channels get channels of their own, which give them.
    export_messages(tmp_path, plate_messages(plate, channels, 2 * loads), "other.c3d")
    content = read_ezc3d(tmp_path / "other.c3d")
    assert content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"].tolist() == [2]
    assert content["data"]["analogs"].shape == (1, num_channels + 6, 40)
    (other,) = content["data"]["platform"]
    assert np.allclose(other["force"], 2 * computed["force"], rtol=1e-4, atol=1e-2)
    assert np.allclose(other["moment"], 2 * computed["moment"], rtol=1e-4, atol=1.0)


def test_a_plate_without_corners_is_reported(tmp_path: Path) -> None:
    plate = Plate("1", "left")
    messages = plate_messages(plate, np.ones((5, 2)), np.ones((5, 6)))
    job = export_messages(tmp_path, messages, "out.c3d")
    assert job.notes == [
        "force plate 1 (left) was left out: its parameters do not give the corners of a rectangle"
    ]
    assert read_ezc3d(tmp_path / "out.c3d")["data"]["analogs"].shape == (1, 2, 5)
