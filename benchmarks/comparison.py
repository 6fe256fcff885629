"""Comparisons of two programs that are measured alternately: A B A B."""

import math
import statistics
from collections.abc import Sequence
from typing import Self


class Pair:
    """The measured values of two alternately measured programs.

    The ratio of each pair of neighbouring runs is the first program's value divided by the second's.
    """

    def __init__(self, first: str, second: str) -> None:
        self._names = (first, second)
        self._values: dict[str, list[float]] = {first: [], second: []}

    @classmethod
    def of(cls, values: dict[str, list[float]]) -> Self:
        """Return the pair from which ``as_dict`` returned ``values``."""
        pair = cls(*values)
        pair._values = {name: list(each) for name, each in values.items()}
        return pair

    def as_dict(self) -> dict[str, list[float]]:
        """Return the values of both programs in the order of measurement, rounded to 5 digits."""
        return {name: [float(f"{value:.5g}") for value in each] for name, each in self._values.items()}

    def add(self, name: str, value: float) -> None:
        """Add the next value of one of the two programs."""
        self._values[name].append(value)

    def median(self, name: str) -> float:
        """Return the median of one program's values."""
        return statistics.median(self._values[name])

    @property
    def ratios(self) -> list[float]:
        """The ratios of all pairs of neighbouring runs."""
        first, second = (self._values[name] for name in self._names)
        return [one / other for one, other in zip(first, second, strict=True)]

    @property
    def ratio(self) -> float:
        """The median of the ratios."""
        return statistics.median(self.ratios)


def table_cell(pair: Pair) -> str:
    """Return the median ratio, and in brackets the smallest and the largest, as text."""
    return f"{pair.ratio:.2f} ({min(pair.ratios):.2f}–{max(pair.ratios):.2f})"


def percentile(values: Sequence[float], per_cent: float) -> float:
    """Return the smallest value that ``per_cent`` % of the values do not exceed (nearest rank)."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * per_cent / 100) - 1)]
