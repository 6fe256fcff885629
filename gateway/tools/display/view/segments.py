"""Links between the markers of a body segment, found from the motion of the markers.

The distance between two markers of a segment stays constant while they move. Only frames in which a marker
has moved are evidence: of a subject that stands still, all distances are constant.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from gateway.takes.files.component_rows import Array

MAX_MARKERS: Final = 300
"""How many markers are considered, the first ones: the number of pairs grows with its square."""

NUM_FRAMES: Final = 100
"""How many frames are evidence, the newest ones with motion: at 8 frames per second those of 12 s."""

MIN_FRAMES: Final = 16
"""In how many of these frames one of two markers has moved before they are linked: two steps of a person."""

STEP_MM: Final = 50.0
"""How far a marker moves until it counts as moved. A person who stands still sways less."""

MAX_LENGTH_MM: Final = 600.0
"""No segment of a person has markers farther apart."""

_TOLERANCE: Final = 0.03
_TOLERANCE_MM: Final = 4.0
"""By how much the length of a link varies at most, relative or absolute: markers move with the skin."""

_KEPT: Final = 1.5
"""How much more the length of a link may vary once it is found, so that links do not come and go."""

_OUTLIERS: Final = 0.03
"""Which share of the lengths of a pair is ignored at either end: markers are mixed up at times."""

_MAX_PAIRS: Final = 1500
"""How many pairs are measured in all frames, the shortest ones: this takes a few ms."""

_NUM_COARSE: Final = 12
_MAX_COARSE_DISTANCES: Final = 200_000
_COARSE: Final = 2.0
"""Before, all pairs are measured in _NUM_COARSE frames, or in fewer if there are many pairs; this takes a few
ms, too. Only those go on whose length varies by less than _COARSE times the tolerance."""


class LinkFinder:
    """Finds the links between markers while frames arrive.

    Markers whose labels begin with different subjects, as ``Anna:LASI`` does, are never linked.
    """

    def __init__(self, labels: Sequence[str]) -> None:
        subjects = np.array([subject_of(label) for label in labels[:MAX_MARKERS]], str)
        self._may_link = np.triu(subjects[:, None] == subjects, 1)
        num_markers = len(subjects)
        self._frames = np.full((NUM_FRAMES, num_markers, 3), np.nan, np.float32)
        self._has_moved = np.zeros((NUM_FRAMES, num_markers), bool)
        self._num_added = 0
        self._last_mm = np.full((num_markers, 3), np.nan, np.float32)  # where each one was when it last moved
        self._links = np.empty((0, 2), int)
        self._lengths_mm = np.empty(0)

    def add(self, positions_mm: Array) -> None:
        """Take a frame, shape (markers, 3); NaN is out of view. It is evidence if a marker has moved."""
        positions = positions_mm[: len(self._last_mm)].astype(np.float32)
        has_moved = _lengths_of(positions - self._last_mm) >= STEP_MM
        is_placed = has_moved | np.isnan(self._last_mm[:, 0])
        self._last_mm[is_placed] = positions[is_placed]
        if has_moved.any():
            place = self._num_added % NUM_FRAMES
            self._frames[place], self._has_moved[place] = positions, has_moved
            self._num_added += 1

    def find(self) -> Array:
        """Return the links as pairs of markers, shape (links, 2), from the shortest to the longest.

        They form a forest. A link that was found before remains as long as nothing contradicts it, also
        while one of its markers is out of view.
        """
        num_known = len(self._links)
        # A pair that occurs twice is chosen once, and then with the tolerance of a known link.
        pairs = np.concatenate([self._links, self._candidates()])
        found = self._measure(pairs)
        is_known = np.arange(len(pairs)) < num_known
        has_evidence = found.counts >= MIN_FRAMES
        tolerances_mm = _tolerances_mm(found.medians_mm) * np.where(is_known, _KEPT, 1.0)
        is_rigid = (found.ranges_mm < tolerances_mm) & (found.medians_mm < MAX_LENGTH_MM)
        is_link = np.where(has_evidence, is_rigid, is_known)
        lengths_mm = found.medians_mm
        is_unproven = is_known & ~has_evidence
        lengths_mm[is_unproven] = self._lengths_mm[is_unproven[:num_known]]
        pairs, lengths_mm = pairs[is_link], lengths_mm[is_link]
        chosen = _forest(pairs, lengths_mm)
        self._links, self._lengths_mm = pairs[chosen], lengths_mm[chosen]
        return self._links

    def _candidates(self) -> Array:
        """Return pairs that may be links, shape (pairs, 2), after a look at a few frames."""
        num_frames, num_markers = min(self._num_added, NUM_FRAMES), len(self._last_mm)
        num_coarse = min(num_frames, _NUM_COARSE, _MAX_COARSE_DISTANCES // max(1, num_markers**2))
        frames = self._frames[np.linspace(0, num_frames - 1, num_coarse).astype(int)]
        distances = _lengths_of(frames[:, :, None] - frames[:, None])
        # Of two markers that are never in view together, -inf and inf: they are measured last.
        longest = np.fmax.reduce(distances, initial=-np.inf)
        shortest = np.fmin.reduce(distances, initial=np.inf)
        counts = self._has_moved.sum(axis=0)
        is_candidate = self._may_link & (counts[:, None] + counts >= MIN_FRAMES)
        is_candidate &= longest < MAX_LENGTH_MM + _COARSE * _TOLERANCE * MAX_LENGTH_MM
        is_candidate &= longest - shortest < _COARSE * _tolerances_mm(longest)
        pairs = np.argwhere(is_candidate)
        return pairs[np.argsort(abs(longest[is_candidate]))[:_MAX_PAIRS]]

    def _measure(self, pairs: Array) -> "_Lengths":
        """Measure pairs of markers, shape (pairs, 2), in all frames in which one of the two has moved."""
        first, second = pairs.T
        frames, has_moved = self._frames.transpose(1, 0, 2), self._has_moved.T
        lengths = _lengths_of(frames[first] - frames[second])
        lengths[~(has_moved[first] | has_moved[second])] = np.nan
        lengths.sort(axis=1)  # NaN is at the end
        counts = np.isfinite(lengths).sum(axis=1)

        def at(share: Array) -> Array:
            return np.take_along_axis(lengths, share.astype(int)[:, None], axis=1)[:, 0].astype(float)

        last = np.maximum(0, counts - 1)
        ranges = at(np.ceil((1 - _OUTLIERS) * last)) - at(np.floor(_OUTLIERS * last))
        return _Lengths(counts, at(last / 2), ranges)


class _Lengths(NamedTuple):
    """The lengths of pairs of markers, each of shape (pairs,). NaN is without a frame."""

    counts: Array
    """In how many frames the length is known."""
    medians_mm: Array
    ranges_mm: Array
    """By how much the length varies, without outliers."""


def _lengths_of(vectors: Array) -> Array:
    """Return the lengths of vectors, shape (…, 3). This is several times faster than numpy.linalg.norm."""
    lengths: Array = np.sqrt(np.einsum("...i,...i", vectors, vectors))
    return lengths


def _tolerances_mm(lengths_mm: Array) -> Array:
    tolerances: Array = np.maximum(_TOLERANCE * lengths_mm, _TOLERANCE_MM)
    return tolerances


def _forest(pairs: Array, lengths_mm: Array) -> list[int]:
    """Return which pairs join all markers that pairs join, the shortest first (Kruskal's algorithm)."""
    roots: dict[int, int] = {}

    def root(marker: int) -> int:
        while (above := roots.get(marker, marker)) != marker:
            roots[marker] = marker = roots.get(above, above)
        return marker

    chosen = []
    for index in np.argsort(lengths_mm, kind="stable").tolist():
        first, second = map(root, pairs[index].tolist())
        if first != second:
            roots[first] = second
            chosen.append(index)
    return chosen


def subject_of(label: str) -> str:
    """Return the subject that a label such as ``Anna:LASI`` names; empty if it names none."""
    return label.rpartition(":")[0]
