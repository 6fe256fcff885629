"""Force plates: the loads that ezc3d computes from the exported channels are those that were recorded."""

import math
from dataclasses import replace

import numpy as np
import pytest

from gateway.messages.descriptions.force_plates import (
    CALIBRATED,
    EIGHT_FORCES,
    FORCES_AND_MOMENTS,
    channels_from_loads,
    force_on,
    geometry_of,
    ground_reactions,
    is_equal,
    loads_from_channels,
    moment_factor,
    own_channels,
    placed_plates,
    possible_types,
    unknown_units,
    up_axis_of,
)
from gateway.rtc3d.parameters import (
    AnalogChannel,
    ForceChannel,
    Parameters,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Point,
)

CORNERS = (Point(508, 464, 0), Point(508, 0, 10), Point(0, 0, 10), Point(0, 464, 0))
PLATE = Plate("1", corners=CORNERS, origin=Point(1.5, -0.8, -34))


def test_channels_give_the_loads_from_which_they_were_computed() -> None:
    geometry = geometry_of(PLATE, "mm")
    assert geometry
    loads = np.random.default_rng(1).normal(size=(50, 6)) * 500
    channels = channels_from_loads(loads, geometry)
    assert np.allclose(loads_from_channels(FORCES_AND_MOMENTS, channels, np.zeros((6, 6)), geometry), loads)


@pytest.mark.parametrize(
    "corners",
    [
        (),
        CORNERS[:3],
        (Point(), Point(), Point(), Point()),
        (Point(0, 0, 0), Point(1, 0, 0), Point(2, 0, 0), Point(3, 0, 0)),
        (Point(1, 1, 1),) * 4,
        (Point(1e200, 0, 0), Point(0, 0, 0), Point(0, 1e200, 0), Point(1e200, 1e200, 0)),
    ],
)
def test_a_plate_needs_four_corners_that_span_a_surface(corners: tuple[Point, ...]) -> None:
    assert geometry_of(replace(PLATE, corners=corners), "mm") is None


def test_positions_have_the_unit_of_the_points() -> None:
    """A plate may be in any unit that markers have."""
    for origin, unit, expected, corner in (
        (Point(0.1, 0.2, -0.3, "m"), "mm", [100, 200, -300], [508, 464, 0]),
        (Point(1, 2, -3, "Feet"), "dm", [3.048, 6.096, -9.144], [5.08, 4.64, 0]),
        (None, "m", [0, 0, 0], [0.508, 0.464, 0]),
    ):
        geometry = geometry_of(replace(PLATE, origin=origin), unit)
        assert geometry
        assert geometry.origin.tolist() == pytest.approx(expected)
        assert geometry.corners[0].tolist() == pytest.approx(corner)


def plate_in(force_unit: str, moment_unit: str) -> Plate:
    units = [force_unit] * 3 + [moment_unit] * 3
    return replace(PLATE, channels=tuple(ForceChannel(str(n), unit=unit) for n, unit in enumerate(units)))


@pytest.mark.parametrize(
    ("force_unit", "moment_unit", "position_unit", "factor"),
    [
        *(
            ("N", "Nm", "mm", 1000),
            ("N", " Nmm", "mm", 1),
            ("N", "N.m", "mm", 1000),
            ("N", "N·mm", "m", 0.001),
        ),
        *(("N", "N*m", "m", 1), ("N", "", "mm", 1), ("N", "lbf", "mm", 1), ("N", "Nm", "furlong", 1)),
        *(
            ("kN", "kNm", "mm", 1000),
            ("kN", "Nm", "m", 0.001),
            ("N", "kNm", "m", 1000),
            ("", "Nm", "cm", 100),
        ),
    ],
)
def test_moments_have_the_units_of_forces_and_points(
    force_unit: str, moment_unit: str, position_unit: str, factor: float
) -> None:
    found = moment_factor(plate_in(force_unit, moment_unit), position_unit)
    assert found == pytest.approx(factor)


def test_units_that_are_not_known_are_named() -> None:
    assert unknown_units(plate_in("lb", "N furlong")) == ["lb", "N furlong"]
    assert unknown_units(plate_in("kN", "")) == unknown_units(PLATE) == []


def test_own_channels_are_found_by_their_ids() -> None:
    analog = ParametersAnalog(tuple(AnalogChannel(name) for name in ("7", "a", "9")))
    assert own_channels(replace(PLATE, analog_channel_ids=("9", "7")), analog) == (2, 0)
    assert own_channels(replace(PLATE, analog_channel_ids=("9", "8")), analog) == ()
    assert own_channels(replace(PLATE, analog_channel_ids=("9",)), None) == ()


def test_the_type_follows_from_the_channels_and_the_calibration() -> None:
    calibrated = replace(PLATE, calibration_matrix=tuple(map(tuple, np.eye(6).tolist())))
    assert possible_types(PLATE, 6) == (FORCES_AND_MOMENTS,)
    assert possible_types(calibrated, 6) == (CALIBRATED, FORCES_AND_MOMENTS)
    assert possible_types(PLATE, 8) == (EIGHT_FORCES,)
    assert possible_types(PLATE, 4) == ()
    for odd in (((1.0,) * 5,) * 6, ((math.nan,) * 6,) * 6):
        assert possible_types(replace(PLATE, calibration_matrix=odd), 6) == (FORCES_AND_MOMENTS,)


def test_loads_are_compared_by_the_largest_of_their_kind() -> None:
    loads = np.array([[100.0, 0, 700, 20_000, -50_000, 0]])
    assert is_equal(loads, loads + np.array([0.5, 0, 0, 40, 0, 0]))
    assert not is_equal(loads, loads + np.array([1, 0, 0, 0, 0, 0]))
    assert not is_equal(loads, loads + np.array([0, 0, 0, 0, 0, 60]))
    assert is_equal(np.zeros((0, 6)), np.zeros((0, 6)))


def plate_with(*corners: tuple[float, float, float]) -> Parameters:
    return Parameters(force=ParametersForce((Plate("1", corners=tuple(Point(*each) for each in corners)),)))


def test_plates_that_lie_flat_tell_what_is_up_unless_they_disagree() -> None:
    x_up = plate_with((0, 0, 0), (0, 400, 0), (0, 400, 600), (0, 0, 600))
    y_up = plate_with((0, 0, 0), (0, 0, 400), (600, 0, 400), (600, 0, 0))
    z_up = plate_with((0, 0, 0), (400, 0, 0), (400, 600, 0), (0, 600, 0))
    tilted = plate_with((0, 0, 0), (400, 0, 300), (400, 600, 300), (0, 600, 0))
    assert [up_axis_of([Parameters(), each]) for each in (x_up, y_up, z_up)] == ["x", "y", "z"]
    for plates in ([y_up, z_up], [tilted], [Parameters()]):
        assert up_axis_of(plates) is None


LOADS = np.array(
    [
        # 800 N upwards, 100 N to the side; 0.1 m from the centre along x, 0.05 m along y; 4 Nm about it.
        [100.0, 0, 800, 40, -80, 4 - 5],
        [0, 0, 9, 0.5, 0, 0],
        [0, 0, math.nan, 0, 0, 0],
    ]
)


def test_ground_reactions_worked_out_by_hand() -> None:
    """M = r × F + T: with r = (0.1, 0.05, 0) and F = (100, 0, 800), r × F is (40, -80, -5)."""
    found = ground_reactions(LOADS, np.array([0.0, 0, 1]), np.array([0.2, 0.3, 0.01]))
    assert found.forces.tolist() == [[100, 0, 800], [0, 0, 0], [0, 0, 0]]
    assert found.positions[0] == pytest.approx([0.3, 0.35, 0.01])
    assert found.positions[1:].tolist() == [[0.2, 0.3, 0.01]] * 2
    assert found.free_moments[0] == pytest.approx([0, 0, 4])
    assert not found.free_moments[1:].any()
    below = ground_reactions(LOADS, np.array([0.0, 0, 1]), np.zeros(3), min_force_n=9)
    assert below.forces[1].tolist() == [0, 0, 9]
    assert below.positions[1] == pytest.approx([0, 0.5 / 9, 0])


def test_ground_reactions_without_a_limit_are_those_of_the_live_view() -> None:
    """Of a plate that is tilted, in the axes of the laboratory."""
    geometry = geometry_of(PLATE, "m")
    assert geometry
    [plate] = placed_plates(Parameters(force=ParametersForce((PLATE,))))
    assert plate
    loads = np.random.default_rng(3).normal(size=(20, 6)) * 300
    loads[0] = 0
    found = ground_reactions(loads, geometry.rotation[:, 2], geometry.corners.mean(axis=0), min_force_n=0)
    for row, load in enumerate(loads.tolist()):
        live = force_on(plate, tuple(load))
        if live is not None:
            assert found.positions[row] == pytest.approx(live.position)
            assert found.forces[row] == pytest.approx(live.force)
    assert np.isfinite(np.concatenate(found)).all()
