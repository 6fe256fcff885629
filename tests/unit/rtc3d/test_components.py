"""What is visible, by the values of an item."""

import math

import numpy as np
import pytest

from gateway.rtc3d.components import ITEM_DTYPES, MISSING, MISSING_MARKER, ComponentType, is_visible

MARKER = (1.0, 2.0, 3.0, 0.5)
TOOL = (1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.5)


def with_nan(item: tuple[float, ...], field: int) -> tuple[float, ...]:
    return (*item[:field], math.nan, *item[field + 1 :])


@pytest.mark.parametrize(
    ("component", "items", "expected"),
    [
        (
            ComponentType.MARKERS,
            [
                MARKER,
                MISSING_MARKER,
                (1.0, math.inf, 3.0, 0.5),
                *(with_nan(MARKER, field) for field in range(4)),
            ],
            [True, False, False, False, False, False, True],
        ),
        (
            ComponentType.TOOLS,
            [TOOL, (MISSING,) * 8, *(with_nan(TOOL, field) for field in range(8))],
            [True, False, *[False] * 7, True],
        ),
    ],
)
def test_what_has_a_nan_in_its_position_or_orientation_is_missing(
    component: ComponentType, items: list[tuple[float, ...]], expected: list[bool]
) -> None:
    """The reliability of a marker and the error of a tool do not count."""
    for dtype in (ITEM_DTYPES[component], ITEM_DTYPES[component].newbyteorder("=")):
        assert is_visible(np.array(items, dtype)).tolist() == expected
        assert is_visible(np.array([items, items], dtype)).tolist() == [expected, expected]
