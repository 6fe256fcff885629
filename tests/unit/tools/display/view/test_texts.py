"""Numbers and text from the network as HTML, and the camera."""

import math

import numpy as np
import pytest

from gateway.tools.display.statistics import Percentiles
from gateway.tools.display.view.scene import sphere_around
from gateway.tools.display.view.scene_items import MAX_M, positions_in_metres
from gateway.tools.display.view.texts import (
    NONE,
    clock_text,
    event_time_text,
    html_text,
    known_rate_text,
    milliseconds_text,
    percentiles_text,
    share_text,
)


def test_text_from_the_network_is_shown_and_is_no_html() -> None:
    hostile = ("<img src=x>", "[x](http://192.0.2.1)", "a\"b&c'", "a\nb\x1b", "ab\u202ecd")
    shown = ["&lt;img src=x&gt;", hostile[1], "a&quot;b&amp;c&#x27;", "a\\nb\\x1b", "ab\\u202ecd"]
    assert [html_text(text) for text in hostile] == shown
    assert html_text("<" * 1_000_000, 5) == "&lt;" * 4 + "…"


def test_numbers() -> None:
    rates = (0, 59.94, 199.96, 999.96, 2000.4, None, math.nan)
    assert [known_rate_text(each) for each in rates] == ["0", "59.9", "200", "1000", "2000", NONE, NONE]
    latencies = (0.123, 9.996, 12.34, -3.456, 99.96, 1234.4, math.inf)
    texts = ["0.12", "10.0", "12.3", "-3.46", "100", "1234", NONE]
    assert [milliseconds_text(each) for each in latencies] == texts
    assert [percentiles_text(each) for each in (Percentiles(1.25, 15.04), None)] == ["1.25 / 15.0", NONE]
    shares = (0, 1, 0.9999, 0.00001, 0.5)  # only all frames are 100 %
    assert [share_text(each) for each in shares] == ["0 %", "100 %", "99.9 %", "0.1 %", "50.0 %"]


def test_times() -> None:
    assert len(clock_text(1_700_000_000)) == len("14:03:22")
    assert event_time_text(1_700_000_000_125_999).endswith(":20.125")
    for utime in (1 << 62, -(1 << 63), (1 << 63) - 1):  # which no calendar has
        assert event_time_text(utime)


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
    assert sphere_around([points((-1, 0, 0), (3, 0, 0)), points((NAN, NAN, NAN))]) == ((1.0, 0.0, 0.0), 2.0)
    near = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    for sphere, limit in (
        (sphere_around([near, points((900, 0, 0))]), 3),
        (sphere_around([points((1, 2, 3))]), 99),
    ):
        assert sphere is not None
        assert 0 < sphere.radius < limit  # one point far away does not move the camera away
    assert sphere_around([points((NAN, NAN, NAN))]) is None
    assert sphere_around([]) is None
