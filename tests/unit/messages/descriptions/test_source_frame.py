import math
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.config.settings import SourceSettings
from gateway.config.values import TransformSettings, Unit
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.source_frame import source_frame
from gateway.messages.encode import metres_per_unit
from gateway.rtc3d.parameters import Parameters, Parameters3D
from tests.support.configurations import mistakes


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


def test_all_units_of_the_settings_are_known() -> None:
    units = get_args(get_args(Unit)[0])
    assert len(units) == 7
    assert all(metres_per_unit(unit) for unit in units)


@pytest.mark.parametrize(
    ("transform", "axes"),
    [
        ({"up": "y"}, [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),  # y becomes z
        ({"rotation_deg": {"roll": 90}}, [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        ({"rotation_deg": {"pitch": 90}}, [[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
        ({"rotation_deg": {"yaw": 90}}, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        # Roll first: y goes to z, and from there yaw does not move it.
        ({"rotation_deg": {"roll": 90, "yaw": 90}}, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    ],
)
def test_up_and_angles_turn_about_fixed_axes(transform: dict[str, Any], axes: list[list[float]]) -> None:
    frame = frame_of("m", **transform)
    assert [moved(frame, 1, 0, 0), moved(frame, 0, 1, 0), moved(frame, 0, 0, 1)] == axes


@given(st.tuples(*[st.integers(-180, 180)] * 3), st.tuples(*[st.integers(-3, 3)] * 3))
def test_a_rotation_turns_what_up_has_made_upright(
    angles: tuple[int, int, int], position: tuple[int, int, int]
) -> None:
    """The axes of ``rotation_deg`` are those of the frame in which poses are published."""
    rotation = dict(zip(("roll", "pitch", "yaw"), angles, strict=True))
    upright = moved(frame_of("m", up="y"), *position)
    expected = moved(frame_of("m", rotation_deg=rotation), *upright)
    assert moved(frame_of("m", up="y", rotation_deg=rotation), *position) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("transform", "key", "text"),
    [
        ({"units": "feet"}, "units", "found 'feet'; expected m, dm, cm, mm, um, in or ft"),
        ({"up": "x"}, "up", "found 'x'; expected y or z"),
        ({"scale": 0}, "scale", "found 0; expected "),
        ({"scale": "1e-3"}, "scale", "found '1e-3' ("),
        ({"rotation_xyzw": [0, 0, 1, 1]}, "rotation_xyzw", "found [0, 0, 1, 1]"),
        (
            {"rotation_xyzw": [0, 0, 0, 0]},
            "rotation_xyzw",
            "found only zeros",
        ),
        ({"rotation_xyzw": [0, 0, 1]}, "rotation_xyzw", "found [0, 0, 1]; expected "),
        ({"rotation_xyzw": [0, 0, math.nan, 1]}, "rotation_xyzw.2", "found nan; expected "),
        ({"rotation_xyzw": {"w": 1}}, "rotation_xyzw", "found a mapping; expected "),
        ({"translation_m": [1, "2 m", 3]}, "translation_m.1", "found '2 m'; expected "),
        (
            {"translation_m": [1, 2]},
            "translation_m",
            "found [1, 2]; expected ",
        ),
        (
            {"rotation_xyzw": [0, 0, 0, 1], "rotation_deg": {"yaw": 1}},
            "rotation_deg",
            "found rotation_xyzw, too;",
        ),
        (
            {"rotation_deg": {"yaw": 361}},
            "rotation_deg.yaw",
            "found 361; expected ",
        ),
    ],
)
def test_mistakes_are_told_with_what_is_expected(transform: dict[str, Any], key: str, text: str) -> None:
    [(found_key, found)] = mistakes(TransformSettings, transform)
    assert (found_key, found[: len(text)]) == (key, text)


@pytest.mark.parametrize("frame_id", ["", "/world", "two words", "x" * 65, 7])
def test_a_frame_has_a_valid_name(frame_id: Any) -> None:
    [(key, _)] = mistakes(SourceSettings, {"name": "lab", "host": "192.0.2.20", "frame_id": frame_id})
    assert key == "frame_id"
