import math
from typing import Any, get_args

import numpy as np
import pytest

from gateway.config.settings import SourceSettings
from gateway.config.transform import TransformSettings, Unit
from gateway.descriptions.source_frame import source_frame
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.tool_pose import metres_per_unit
from gateway.rtc3d.parameters import Parameters, Parameters3D
from tests.settings import mistakes


def frame_of(unit: str | None = "mm", frame_id: str | None = None, **transform: Any) -> CoordinateFrame:
    values = {"name": "lab", "host": "192.0.2.20", "frame_id": frame_id, "transform": transform}
    parameters = Parameters(markers=None if unit is None else Parameters3D(unit=unit))
    return source_frame(SourceSettings.model_validate(values), parameters)


def moved(frame: CoordinateFrame, *position: float) -> list[float]:
    [point] = np.round(frame.points(np.array([position])), 9).tolist()
    return [value + 0.0 for value in point]  # no -0.0


def test_without_settings_a_frame_has_the_name_of_the_source_and_the_unit_of_the_server() -> None:
    assert frame_of("cm") == CoordinateFrame("lab", 0.01)
    assert frame_of(None) == CoordinateFrame("lab", 0.001)
    assert frame_of("furlong") == CoordinateFrame("lab", None)


def test_settings_name_the_frame_and_the_unit() -> None:
    expected = CoordinateFrame("world/hall", 0.0508, scale=2.0)
    assert frame_of("furlong", "world/hall", units="in", scale=2.0) == expected
    assert frame_of("mm", units="ft") == CoordinateFrame("lab", 0.3048)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        (" MM ", 1e-3),
        ("M", 1.0),
        ("Millimeters", 1e-3),
        ("\u00b5m", 1e-6),  # the micro sign
        ("\u03bcm", 1e-6),  # the Greek letter
        ("inch", 0.0254),
        ("Feet", 0.3048),
        ("", 1e-3),
        ("mV", None),
        ("m m", None),
    ],
)
def test_units_have_several_names(unit: str, metres: float | None) -> None:
    assert frame_of(unit).metres_per_unit == metres


def test_all_units_of_the_settings_are_known() -> None:
    units = get_args(get_args(Unit)[0])
    assert len(units) == 7
    assert all(metres_per_unit(unit) for unit in units)


def test_y_up_becomes_z_up() -> None:
    frame = frame_of("m", up="y")
    assert moved(frame, 1, 0, 0) == [1, 0, 0]
    assert moved(frame, 0, 1, 0) == [0, 0, 1]  # up
    assert moved(frame, 0, 0, 1) == [0, -1, 0]


@pytest.mark.parametrize(
    ("angles", "of_x", "of_y", "of_z"),
    [
        ({"roll": 90}, [1, 0, 0], [0, 0, 1], [0, -1, 0]),
        ({"pitch": 90}, [0, 0, -1], [0, 1, 0], [1, 0, 0]),
        ({"yaw": 90}, [0, 1, 0], [-1, 0, 0], [0, 0, 1]),
        # Roll first: y goes to z, and from there yaw does not move it.
        ({"roll": 90, "yaw": 90}, [0, 1, 0], [0, 0, 1], [1, 0, 0]),
    ],
)
def test_angles_turn_about_fixed_axes(
    angles: dict[str, float], of_x: list[float], of_y: list[float], of_z: list[float]
) -> None:
    frame = frame_of("m", rotation_deg=angles)
    assert [moved(frame, 1, 0, 0), moved(frame, 0, 1, 0), moved(frame, 0, 0, 1)] == [of_x, of_y, of_z]


def test_the_rotation_follows_up_and_the_translation_follows_both() -> None:
    frame = frame_of("mm", up="y", rotation_deg={"yaw": 90}, translation_m=[10, 0, 1])
    assert moved(frame, 0, 0, 1000) == [11, 0, 1]  # to -y by up, to x by yaw


def test_a_quaternion_is_the_same_as_its_angles() -> None:
    half = math.sqrt(0.5)
    quaternion = frame_of("m", rotation_xyzw=[0, 0, round(half, 3), round(half, 3)])
    assert quaternion.rotation_xyzw == pytest.approx(frame_of("m", rotation_deg={"yaw": 90}).rotation_xyzw)
    assert math.hypot(*quaternion.rotation_xyzw) == pytest.approx(1)


@pytest.mark.parametrize(
    ("transform", "mistake"),
    [
        (
            {"units": "feet"},
            ("units", "found 'feet'; expected m, dm, cm, mm, um, in or ft, or null for the server's"),
        ),
        ({"up": "x"}, ("up", "found 'x'; expected y or z")),
        ({"scale": 0}, ("scale", "found 0; expected a number from 0.000001 to 1000000")),
        (
            {"scale": "1e-3"},
            ("scale", "found '1e-3' (write it as 0.001); expected a number from 0.000001 to 1000000"),
        ),
        (
            {"rotation_xyzw": [0, 0, 1, 1]},
            (
                "rotation_xyzw",
                "found [0, 0, 1, 1], whose squares do not add up to 1; "
                "expected x y z w, such as [0, 0, 0.7071, 0.7071]",
            ),
        ),
        (
            {"rotation_xyzw": [0, 0, 0, 0]},
            ("rotation_xyzw", "found only zeros, which is no rotation; expected [0, 0, 0, 1] for none"),
        ),
        (
            {"rotation_xyzw": [0, 0, 1]},
            (
                "rotation_xyzw",
                "found [0, 0, 1]; expected a list of four numbers, x y z w, such as [0, 0, 0, 1]",
            ),
        ),
        (
            {"rotation_xyzw": [0, 0, math.nan, 1]},
            ("rotation_xyzw.2", "found nan; expected a number from -1000000 to 1000000"),
        ),
        (
            {"rotation_xyzw": {"w": 1}},
            (
                "rotation_xyzw",
                "found a mapping; expected a list of four numbers, x y z w, such as [0, 0, 0, 1]",
            ),
        ),
        (
            {"translation_m": [1, "2 m", 3]},
            ("translation_m.1", "found '2 m'; expected a number from -1000000 to 1000000"),
        ),
        (
            {"translation_m": [1, 2]},
            (
                "translation_m",
                "found [1, 2]; expected a list of three numbers of metres, x y z, such as [2.5, 0, 0]",
            ),
        ),
        (
            {"rotation_xyzw": [0, 0, 0, 1], "rotation_deg": {"yaw": 1}},
            ("rotation_deg", "found rotation_xyzw, too; expected one of the two"),
        ),
        (
            {"rotation_deg": {"yaw": 361}},
            ("rotation_deg.yaw", "found 361; expected a number of degrees from -360 to 360"),
        ),
    ],
)
def test_mistakes_are_told_with_what_is_expected(transform: dict[str, Any], mistake: tuple[str, str]) -> None:
    assert mistakes(TransformSettings, transform) == [mistake]


@pytest.mark.parametrize("frame_id", ["", "/world", "two words", "x" * 65, 7])
def test_a_frame_has_a_valid_name(frame_id: Any) -> None:
    values = {"name": "lab", "host": "192.0.2.20", "frame_id": frame_id}
    [(key, _)] = mistakes(SourceSettings, values)
    assert key == "frame_id"
