"""Where the camera stands, and which axis points up."""

import numpy as np
import pytest

from gateway.rtc3d.parameters import Parameters, ParametersForce, Plate, Point
from gateway.view.axes import UpAxis, on_floor, up_axis_of
from gateway.view.camera import sphere_around
from gateway.view.positions import MAX_M, positions_in_metres

NAN = np.nan


def points(*positions: tuple[float, float, float]) -> np.ndarray:
    return np.array(positions)


def items(*positions: tuple[float, float, float]) -> np.ndarray:
    return np.array([*positions], [("x", "f4"), ("y", "f4"), ("z", "f4")])


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.5), ("m", 500), ("cm", 5), ("", 0.5), ("cubit", 0.5)])
def test_positions_are_in_metres(unit: str, metres: float) -> None:
    assert positions_in_metres(items((500, 0, 0)), unit).tolist() == [[metres, 0, 0]]


@pytest.mark.parametrize("value", [NAN, np.inf, -np.inf, 1e30, -3e38, 1.01e3 * MAX_M])
def test_a_position_that_cannot_be_shown_is_missing_as_a_whole(value: float) -> None:
    assert np.isnan(positions_in_metres(items((1, value, 2)), "mm")).all()


def test_the_sphere_is_around_all_points() -> None:
    sphere = sphere_around([points((-1, 0, 0), (3, 0, 0)), points((NAN, NAN, NAN))])
    assert sphere is not None
    assert sphere == ((1.0, 0.0, 0.0), 2.0)


def test_one_point_far_away_does_not_move_the_camera_away() -> None:
    near = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    sphere = sphere_around([near, points((900, 0, 0))])
    assert sphere is not None
    assert sphere.radius < 3


def test_one_point_has_a_sphere_and_none_has_none() -> None:
    sphere = sphere_around([points((1, 2, 3))])
    assert sphere is not None
    assert sphere.radius > 0
    assert sphere_around([points((NAN, NAN, NAN))]) is None
    assert sphere_around([]) is None


def plate_on(up: UpAxis, *, tilted: bool = False) -> Parameters:
    heights = (0.0, 300.0, 300.0, 0.0) if tilted else (0.0,) * 4
    corners = ((0, 0), (400, 0), (400, 600), (0, 600))
    return Parameters(
        force=ParametersForce(
            (
                Plate(
                    "1",
                    corners=tuple(
                        Point(*on_floor(up, *corner, height))
                        for corner, height in zip(corners, heights, strict=True)
                    ),
                ),
            )
        )
    )


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_plates_that_lie_flat_tell_what_is_up(up: UpAxis) -> None:
    assert up_axis_of([Parameters(), plate_on(up)]) == up


def test_plates_that_disagree_or_are_tilted_tell_nothing() -> None:
    assert up_axis_of([plate_on("y"), plate_on("z")]) is None
    assert up_axis_of([plate_on("z", tilted=True)]) is None
    assert up_axis_of([Parameters()]) is None
