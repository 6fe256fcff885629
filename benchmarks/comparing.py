"""Comparisons: two or more that take turns, A B A B, and what their figures say."""

import math
import statistics
from collections.abc import Sequence
from typing import Self


class Pair:
    """Figures of two that took turns; the ratio of each pair of neighbours is the first's to the second's."""

    def __init__(self, first: str, second: str) -> None:
        self._names = (first, second)
        self._values: dict[str, list[float]] = {first: [], second: []}

    @classmethod
    def of(cls, values: dict[str, list[float]]) -> Self:
        """Return what ``as_dict`` told."""
        pair = cls(*values)
        pair._values = {name: list(each) for name, each in values.items()}
        return pair

    def as_dict(self) -> dict[str, list[float]]:
        """Return the figures of both, in the order in which they were measured."""
        return {name: [float(f"{value:.5g}") for value in each] for name, each in self._values.items()}

    def add(self, name: str, value: float) -> None:
        """Note the next figure of one of the two."""
        self._values[name].append(value)

    def median(self, name: str) -> float:
        """Return the median of one of the two."""
        return statistics.median(self._values[name])

    @property
    def ratios(self) -> list[float]:
        """The ratio of every pair."""
        first, second = (self._values[name] for name in self._names)
        return [one / other for one, other in zip(first, second, strict=True)]

    @property
    def ratio(self) -> float:
        """The median of the ratios."""
        return statistics.median(self.ratios)


def table_cell(pair: Pair) -> str:
    """Return the ratio and its spread, from the least to the greatest pair."""
    return f"{pair.ratio:.2f} ({min(pair.ratios):.2f}–{max(pair.ratios):.2f})"


def percentile(values: Sequence[float], per_cent: float) -> float:
    """Return the least value that so many per cent of all are not above (nearest rank)."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * per_cent / 100) - 1)]
