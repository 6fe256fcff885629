"""Resampling: values between frames, and no values where there were none."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.takes import open_take
from gateway.takes.files.resampling import slerp
from gateway.takes.files.series import Series
from tests.support.errors import raises
from tests.support.takes import START_UTIME, Message, description, frame, markers, write_take
from tests.unit.takes.export.exported import NAN, labelled

Captured = tuple[float, Sequence[Any]]
"""When a frame was captured, in seconds since the beginning of the take, and its items."""


def captured(component: ComponentType, frames: Sequence[Captured], **options: Any) -> list[Message]:
    """Return a message for each frame."""
    times = [START_UTIME + round(seconds * 1e6) + 2000 for seconds, _ in frames]
    return [
        frame(component, items, n, utime=time, **options)
        for n, (time, (_, items)) in enumerate(zip(times, frames, strict=True))
    ]


@pytest.fixture
def series(tmp_path: Path) -> Callable[[ComponentType, Sequence[Captured]], Series]:
    """A function that returns a component with these frames."""

    def opened(component: ComponentType, frames: Sequence[Captured]) -> Series:
        messages = [description(), *captured(component, frames)]
        [found] = open_take(write_take(tmp_path / "a.lcmlog", messages)).sources["lab"].series.values()
        return found

    return opened


Open = Callable[[ComponentType, Sequence[Captured]], Series]


def test_values_are_on_the_line_between_frames_at_multiples_of_the_period(series: Open) -> None:
    rows = [(0.004, [(0, 10, 100, 1)]), (0.014, [(10, 10, 200, 2)]), (0.024, [(30, 10, 100, 1)])]
    found = series(ComponentType.MARKERS, rows).resample(500)
    assert found.seconds.tolist() == [n / 500 for n in range(2, 13)]
    assert found.rate_hz == found.measured_rate_hz == 500
    assert found.values[:, 0, 0].tolist() == [0, 2, 4, 6, 8, 10, 14, 18, 22, 26, 30]
    assert found["marker 1"][3].tolist() == [6, 10, 160]
    assert found.items["reliability"][3, 0] == pytest.approx(1.6)


def test_other_columns_are_those_of_the_nearest_frame(series: Open) -> None:
    found = series(ComponentType.ANALOG, [(0.01 * n, [n]) for n in range(3)]).resample(400)
    assert found.sequence.tolist() == [0, 0, 0, 1, 1, 1, 1, 2, 2]
    assert found.capture_utime.tolist() == [START_UTIME + 2500 * n for n in range(9)]


def test_a_value_at_the_time_of_a_frame_is_as_recorded(series: Open) -> None:
    values = [math.inf, -math.inf, 3.4e38, -3.4e38, 0.1]
    found = series(ComponentType.ANALOG, [(0.01 * n, [value]) for n, value in enumerate(values)])
    assert np.array_equal(found.resample(100).values[:, 0], np.array(values, np.float32))


@pytest.mark.parametrize(
    ("max_gap_s", "filled"), [(0.0, []), (0.03, [3, 4]), (0.049, [3, 4]), (0.05, [3, 4, 9, 10, 11, 12])]
)
def test_gaps_up_to_the_limit_are_filled_and_longer_ones_are_nan(
    series: Open, max_gap_s: float, filled: list[int]
) -> None:
    """Frames 3 and 4 are missing, and the marker in frames 9 to 12."""
    rows = [(0.01 * n, [(NAN if 9 <= n <= 12 else n, 0, 0, 0), (n, 0, 0, 0)]) for n in range(20)]
    found = series(ComponentType.MARKERS, rows[:3] + rows[5:]).resample(100, max_gap_s=max_gap_s)
    first = found.values[:, 0, 0]
    assert first[~np.isnan(first)].tolist() == [
        n for n in range(20) if n in filled or n not in {3, 4, 9, 10, 11, 12}
    ]
    second = found.values[:, 1, 0]
    assert second[~np.isnan(second)].tolist() == [n for n in range(20) if n in filled or n not in {3, 4}]
    assert np.isnan(found.items["reliability"]).tolist() == np.isnan(found.values[..., 0]).tolist()


def test_neighbours_are_interpolated_whatever_the_limit_and_the_reliability(series: Open) -> None:
    """The server may not send a reliability. Frames at 2 Hz are further apart than the default limit."""
    rows = [(0.5 * n, [(n, 0, 0, NAN)]) for n in range(3)]
    for found in (
        series(ComponentType.MARKERS, rows).resample(4, max_gap_s=max_gap_s) for max_gap_s in (0, 0.1)
    ):
        assert found.values[:, 0, 0].tolist() == [0, 0.5, 1, 1.5, 2]
        assert np.isnan(found.items["reliability"]).all()


def test_nothing_is_invented_outside_the_frames_or_between_measurements(tmp_path: Path) -> None:
    first = captured(ComponentType.ANALOG, [(0.01 * n, [1]) for n in range(2, 5)])
    second = captured(ComponentType.ANALOG, [(0.01 * n, [2]) for n in range(6, 9)], session=2)
    take = open_take(write_take(tmp_path / "a.lcmlog", [description(), *first, *second]))
    analog = take.sources["lab"].analog
    assert analog
    found = analog.resample(100, from_s=0.0, to_s=0.1).values[:, 0].tolist()
    assert [0 if math.isnan(value) else value for value in found] == [0, 0, 1, 1, 1, 0, 2, 2, 2, 0, 0]


def test_components_of_a_take_get_one_time_base_and_events_stay(tmp_path: Path) -> None:
    messages = [
        description(),
        *captured(ComponentType.MARKERS, [(0.02 * n, [(n, 0, 0, 0)]) for n in range(2, 6)]),
        *captured(ComponentType.ANALOG, [(0.001 * n, [n]) for n in range(100)], source="studio"),
        *captured(ComponentType.EVENT, [(0.05, [(7, 50_000, -1, -1, -1)])]),
    ]
    take = open_take(write_take(tmp_path / "a.lcmlog", messages))
    resampled = take.resample(250)
    lab, studio = resampled.sources["lab"], resampled.sources["studio"]
    assert lab.markers
    assert studio.analog
    assert lab.events is take.sources["lab"].events
    assert lab.markers.seconds.tolist() == studio.analog.seconds.tolist() == [n / 250 for n in range(26)]
    assert np.isnan(lab.markers.values[:, 0, 0]).tolist() == [True] * 10 + [False] * 16
    assert studio.analog.values[:25, 0].tolist() == [4.0 * n for n in range(25)]
    assert take.sources["lab"].markers is not lab.markers


def test_labels_that_change_stay_with_their_frames(tmp_path: Path) -> None:
    messages = [description(), labelled("a"), *(markers(1, n) for n in range(3))]
    messages += [labelled("a", "b", version=2), *(markers(2, n, version=2) for n in range(3, 6))]
    found = open_take(write_take(tmp_path / "a.lcmlog", messages)).sources["lab"].markers
    assert found
    resampled = found.resample(200)
    assert resampled.labels == ("a", "b")
    b = resampled["b"][:, 1]
    assert np.array_equal(b[~np.isnan(b)], resampled["a"][-len(b[~np.isnan(b)]) :, 1])
    assert np.nanmin(b) > 3 - 1e-3


def test_frames_without_items_have_no_values_and_times_that_go_back_do_no_harm(series: Open) -> None:
    rows: list[Captured] = [(0.0, [(0, 0, 0, 0)]), (0.01, []), (0.03, [(3, 0, 0, 0)]), (0.02, [(9, 0, 0, 0)])]
    found = series(ComponentType.MARKERS, rows).resample(100)
    assert found.values[:, 0, 0].tolist() == [0, 4.5, 9, 3]
    empty = series(ComponentType.MARKERS, [(0.0, []), (0.01, [])]).resample(200)
    assert empty.items.shape == (3, 0)


def about_z(angle: float) -> tuple[float, float, float, float]:
    return math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)


@pytest.mark.parametrize(("angle", "sign"), [*product([1e-9, 0.1, 2.5, math.pi - 1e-3], [1, -1])])
def test_orientations_turn_evenly_the_shorter_way_round(angle: float, sign: int) -> None:
    """q and -q are the same orientation."""
    weights = np.linspace(0, 1, 5)[:, None]
    high = sign * np.array([about_z(angle)])
    found = slerp(np.array([about_z(0)]), high, weights)
    assert found == pytest.approx(np.array([about_z(weight * angle) for [weight] in weights]), abs=1e-12)


def test_tools_have_orientations_by_slerp_and_positions_by_a_line(series: Open) -> None:
    rows = [(0.01 * n, [(*about_z(n * 2.0), 10 * n, 0, 0, 0.5)]) for n in range(2)]
    found = series(ComponentType.TOOLS, rows).resample(400)
    expected = [about_z(angle) for angle in (0, 0.5, 1, 1.5, 2)]
    assert found.quaternions[:, 0] == pytest.approx(np.array(expected), abs=1e-6)
    assert found.positions[:, 0, 0].tolist() == [0, 2.5, 5, 7.5, 10]


def test_loads_are_interpolated(series: Open) -> None:
    rows = [(0.01 * n, [(n, 2 * n, 3 * n, 4 * n, 5 * n, 6 * n)]) for n in range(2)]
    assert series(ComponentType.FORCE, rows).resample(200)["plate 1"][1].tolist() == [0.5, 1, 1.5, 2, 2.5, 3]


def test_what_cannot_be_resampled_is_an_error_that_says_why(series: Open) -> None:
    with raises(TakeError, "events"):
        series(ComponentType.EVENT, [(0.0, [(7, 0, -1, -1, -1)])]).resample(100)
    far = series(ComponentType.ANALOG, [(0.0, [1]), (0.001, [1]), (1e6, [1])])
    with raises(TakeError, "3 frames", "1000000001 rows", "from_s"):
        far.resample(1000)
    assert len(far.resample(1000, to_s=1)) == 1001
    with pytest.raises(TakeError, match="would become 0 rows"):
        far.resample(1000, from_s=1.0001, to_s=1.0002)
    for limits in ({"from_s": NAN}, {"to_s": math.inf}):
        with raises(TakeError, "None"):
            far.resample(1000, **limits)
    for rate_hz, max_gap_s in ((0, 0.1), (-1, 0.1), (NAN, 0.1), (1e9, 0.1), (100, -1)):
        with raises(TakeError, "resample"):
            far.resample(rate_hz, max_gap_s=max_gap_s)


@pytest.mark.parametrize("step_s", [-0.024, -0.503, -1.0, -1.007])
def test_a_step_back_of_the_gateways_clock_mixes_no_moments(series: Open, step_s: float) -> None:
    """Times that occur twice belong to frames before and after the step, and rows are of one of them."""
    rows = [(0.003 + 0.01 * n + (step_s if n >= 300 else 0.0), [n]) for n in range(600)]
    found = series(ComponentType.ANALOG, rows).resample(100)
    values = found.values[:, 0]
    steps = np.diff(values[~np.isnan(values)])
    assert (steps > 0).all()
    assert (steps > 1.5).sum() <= 1
    assert values[~np.isnan(values)].max() > 598
    assert np.count_nonzero(np.isnan(values)) <= 2


def test_overtaken_messages_are_no_step_of_the_clock(tmp_path: Path) -> None:
    messages = captured(ComponentType.ANALOG, [(0.01 * n, [n]) for n in range(50)])
    messages[20], messages[21] = messages[21], messages[20]
    [found] = open_take(write_take(tmp_path / "a.lcmlog", [description(), *messages])).sources.values()
    assert found.analog is not None
    assert found.analog.resample(100).values[:, 0].tolist() == [*range(50)]
