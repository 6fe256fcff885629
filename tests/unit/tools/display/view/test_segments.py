"""Links between markers: of bodies whose links are known by construction, and of the sample take."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.takes import open_take
from gateway.takes.files.component_rows import Array
from gateway.tools.display.view.segments import (
    MAX_LENGTH_MM,
    MAX_MARKERS,
    MIN_FRAMES,
    NUM_FRAMES,
    STEP_MM,
    LinkFinder,
)
from tests.support.documents import ROOT
from tests.support.examples import examples

NOISE_MM = 0.3


class Bodies:
    """Rigid bodies, each with markers within 200 mm, and the finder that sees their frames."""

    def __init__(self, seed: int, *sizes: int) -> None:
        self._random = np.random.default_rng(seed)
        self._shapes = [self._random.uniform(-100, 100, (size, 3)) for size in sizes]
        self.owners = np.repeat(np.arange(len(sizes)), sizes)
        """The body of each marker."""
        self.hidden: list[int] = []
        """The markers out of view."""
        self.num_links = sum(sizes) - len(sizes)
        """How many links there are if all are found."""
        self.finder = LinkFinder([f"marker {number}" for number in range(sum(sizes))])
        self._poses = [self._pose() for _ in sizes]

    def _pose(self) -> tuple[Array, Array]:
        return np.linalg.qr(self._random.normal(size=(3, 3)))[0], self._random.uniform(-1000, 1000, 3)

    def move(self, num_frames: int, *moving: int) -> None:
        """Show frames in which these bodies move, each on its own; all if none is named."""
        for _ in range(num_frames):
            for body in moving or range(len(self._poses)):
                self._poses[body] = self._pose()
            self.show(np.concatenate(self.parts()))

    def move_as_one(self, num_frames: int) -> None:
        """Show frames in which all bodies move as if they were one, side by side."""
        points = np.concatenate(
            [np.add(shape, [200 * place, 0, 0]) for place, shape in enumerate(self._shapes)]
        )
        for _ in range(num_frames):
            turn, place = self._pose()
            self.show(points @ turn + place)

    def stand(self, num_frames: int) -> None:
        """Show frames in which nothing moves."""
        for _ in range(num_frames):
            self.show(np.concatenate(self.parts()))

    def parts(self) -> list[Array]:
        """Return the positions of the markers of each body, shape (markers, 3), in mm."""
        return [shape @ turn + place for shape, (turn, place) in zip(self._shapes, self._poses, strict=True)]

    def show(self, positions_mm: Array) -> None:
        """Show a frame, with noise and without what is hidden."""
        positions = positions_mm + self._random.normal(0, NOISE_MM, positions_mm.shape)
        positions[self.hidden] = np.nan
        self.finder.add(positions)

    def are_true(self, links: Array) -> bool:
        """Return whether all links are within a body, and form a forest."""
        return bool((self.owners[links[:, 0]] == self.owners[links[:, 1]]).all()) and is_forest(links)


def is_forest(links: Array) -> bool:
    """Return whether no marker is joined to another one in two ways."""
    groups: list[set[int]] = []
    for link in links.tolist():
        joined = [group for group in groups if group & {*link}]
        if any({*link} <= group for group in joined):
            return False
        groups = [group for group in groups if group not in joined] + [set(link).union(*joined)]
    return True


def find(labels: Sequence[str], frames: Array) -> set[tuple[int, ...]]:
    """Return the links that are found in frames, shape (frames, markers, 3)."""
    finder = LinkFinder(labels)
    for frame in frames:
        finder.add(frame)
    return {*map(tuple, finder.find().tolist())}


def line(*places_mm: float, num_frames: int = 2 * MIN_FRAMES) -> Array:
    """Return frames of markers on a line that moves along itself, shape (frames, markers, 3)."""
    frames = np.zeros((num_frames, len(places_mm), 3))
    frames[..., 0] = np.array(places_mm) + 2 * STEP_MM * np.arange(num_frames)[:, None]
    return frames


SEED = st.integers(0, 2**32 - 1)


@given(seed=SEED, sizes=st.lists(st.integers(1, 6), min_size=1, max_size=4), gaps=st.floats(0, 0.5))
@settings(max_examples=examples(50))
def test_links_are_within_a_body_whatever_is_out_of_view(seed: int, sizes: list[int], gaps: float) -> None:
    bodies, random = Bodies(seed, *sizes), np.random.default_rng(seed)
    for _ in range(NUM_FRAMES):
        bodies.hidden = np.flatnonzero(random.random(len(bodies.owners)) < gaps).tolist()
        bodies.move(1)
    links = bodies.finder.find()
    assert bodies.are_true(links)
    if gaps < 0.3:  # otherwise, a pair may be in view too rarely
        assert len(links) == bodies.num_links


PHASES = st.tuples(
    st.sampled_from(["stand", "move", "move one", "move as one"]),
    st.integers(1, NUM_FRAMES),
    st.sets(st.integers(0, 8)),
)


@given(seed=SEED, phases=st.lists(PHASES, max_size=8))
@settings(max_examples=examples(50))
def test_links_are_right_in_the_end_whatever_was_before(
    seed: int, phases: list[tuple[str, int, set[int]]]
) -> None:
    """Subjects stand, come and go, carry each other and separate."""
    bodies = Bodies(seed, 4, 3, 2)
    for kind, num_frames, hidden in phases:
        bodies.hidden = [*hidden]
        if kind == "stand":
            bodies.stand(num_frames)
        elif kind == "move":
            bodies.move(num_frames)
        elif kind == "move one":
            bodies.move(num_frames, 0)
        else:
            bodies.move_as_one(num_frames)
        links = bodies.finder.find()
        assert is_forest(links)
        if "move as one" not in {phase[0] for phase in phases}:
            assert bodies.are_true(links)
    bodies.hidden = []
    bodies.move(NUM_FRAMES)
    links = bodies.finder.find()
    assert len(links) == bodies.num_links
    assert bodies.are_true(links)


def test_nothing_is_linked_before_it_has_moved_enough() -> None:
    """All distances of somebody who stands still are constant, also that between the two hands."""
    bodies = Bodies(1, 5, 5)
    bodies.stand(10 * NUM_FRAMES)
    assert len(bodies.finder.find()) == 0
    bodies.move(MIN_FRAMES - 1)
    assert len(bodies.finder.find()) == 0
    bodies.move(1)
    assert len(bodies.finder.find()) == bodies.num_links


def test_who_sways_or_stands_beside_somebody_who_walks_has_no_links_yet() -> None:
    bodies = Bodies(2, 4, 4)
    _, standing = bodies.parts()
    for number in range(NUM_FRAMES):
        bodies.move(1, 0)
        walking, _ = bodies.parts()
        sway_mm = np.array([0.4 * STEP_MM * np.sin(number / 5), 0, 0])
        bodies.show(np.concatenate([walking, standing + sway_mm]))
    links = bodies.finder.find()
    assert bodies.are_true(links)
    assert set(bodies.owners[links].ravel()) == {0}


def test_bodies_that_pass_each_other_are_not_linked() -> None:
    """They come closer than the longest link, at the speed of people."""
    bodies = Bodies(3, 5, 5)
    left, right = (part - part.mean(axis=0) for part in bodies.parts())
    for time_s in np.linspace(-3, 3, 48):
        way = np.array([1200 * time_s, 0, 0])
        bodies.show(np.concatenate([left + way, right - way + [0, 300, 0]]))
    links = bodies.finder.find()
    assert bodies.are_true(links)
    assert len(links) == bodies.num_links


def test_a_link_that_proves_wrong_disappears() -> None:
    bodies = Bodies(4, 2, 2)
    bodies.move_as_one(NUM_FRAMES)
    assert len(bodies.finder.find()) == 3 > bodies.num_links
    bodies.move(NUM_FRAMES // 10)
    links = bodies.finder.find()
    assert len(links) == bodies.num_links
    assert bodies.are_true(links)


@pytest.mark.parametrize("hidden", [[], [0], [0, 1, 2, 3]])
def test_a_link_remains_through_a_gap_and_while_others_move(hidden: list[int]) -> None:
    bodies = Bodies(5, 4, 4)
    bodies.move(NUM_FRAMES)
    links = bodies.finder.find().tolist()
    bodies.hidden = hidden
    bodies.move(2 * NUM_FRAMES, 1)  # no frame with the first body is left
    assert sorted(bodies.finder.find().tolist()) == sorted(links)
    bodies.hidden = []
    bodies.move(1)
    assert sorted(bodies.finder.find().tolist()) == sorted(links)


def test_links_to_a_hidden_marker_are_not_replaced_by_longer_ones() -> None:
    """They would be back only after seconds when the marker is in view again."""
    frames = line(0, 100, 300, num_frames=NUM_FRAMES)
    finder = LinkFinder("ABC")
    for hidden in ([], [1]):
        frames[:, hidden] = np.nan
        for frame in frames:
            finder.add(frame)
        assert {*map(tuple, finder.find().tolist())} == {(0, 1), (1, 2)}


def test_slow_motion_is_motion_too() -> None:
    frames = line(0, 100, num_frames=20 * MIN_FRAMES)
    frames[..., 0] -= 1.9 * STEP_MM * np.arange(len(frames))[:, None]
    assert find("AB", frames) == {(0, 1)}


def test_frames_in_which_only_others_move_are_no_evidence() -> None:
    bodies = Bodies(8, 4, 4)
    bodies.move(MIN_FRAMES - 1)
    bodies.move(NUM_FRAMES // 2, 0)
    links = bodies.finder.find()
    assert set(bodies.owners[links].ravel()) == {0}


def test_many_markers_that_are_never_in_view_do_not_displace_others() -> None:
    bodies = Bodies(9, 40, 60)
    bodies.hidden = [*range(40, 100)]
    bodies.move(NUM_FRAMES)
    assert len(bodies.finder.find()) == 39


def test_a_segment_is_joined_by_its_shortest_distances() -> None:
    assert find("ABCDE", line(0, 400, 100, 250, 500)) == {(0, 2), (2, 3), (1, 3), (1, 4)}


def test_markers_too_far_apart_are_linked_only_through_others() -> None:
    far_mm = MAX_LENGTH_MM + 20
    assert find("AB", line(0, far_mm)) == set()
    assert find("ABC", line(0, far_mm, far_mm / 2)) == {(0, 2), (1, 2)}


def test_subjects_are_not_linked_even_if_they_move_as_one() -> None:
    frames = line(0, 10, 20, 30, 40)
    assert find(["Ben:A", "Ann:A", "Ben:B", "Ann:B", "A"], frames) == {(0, 2), (1, 3)}


@pytest.mark.parametrize(
    ("length_mm", "variation_mm", "is_linked"),
    [(50, 3.5, True), (50, 4.5, False), (500, 14, True), (500, 16, False)],
)
def test_a_length_may_vary_by_4_mm_or_3_percent(
    length_mm: float, variation_mm: float, is_linked: bool
) -> None:
    frames = line(0, length_mm)
    frames[::2, 1, 0] += variation_mm
    assert (find("AB", frames) == {(0, 1)}) is is_linked


def test_links_do_not_come_and_go_while_they_vary_a_little_more() -> None:
    frames = line(0, 100, num_frames=NUM_FRAMES)
    finder = LinkFinder("AB")
    for variation_mm, is_linked in ((5, False), (3, True), (5, True), (7, False), (5, False)):
        for number, frame in enumerate(frames):
            finder.add(np.add(frame, [[0, 0, 0], [variation_mm * (number % 2), 0, 0]]))
        assert (len(finder.find()) == 1) is is_linked


def test_a_few_frames_with_mixed_up_markers_change_nothing() -> None:
    bodies = Bodies(6, 5, 5)
    bodies.move(NUM_FRAMES)
    links = bodies.finder.find().tolist()
    positions = np.concatenate(bodies.parts())
    for _ in range(2):
        bodies.show(positions[::-1])
        bodies.move(30)
    assert sorted(bodies.finder.find().tolist()) == sorted(links)


def test_the_number_of_markers_is_bounded() -> None:
    """Of this many, only the first ones are linked; 300 on one body are the most that there is to compute."""
    bodies = Bodies(7, MAX_MARKERS + 50)
    bodies.move(NUM_FRAMES)
    links = bodies.finder.find()
    assert links.max() == MAX_MARKERS - 1
    assert is_forest(links)
    assert len(links) > 0.9 * MAX_MARKERS


def test_no_marker_has_no_link() -> None:
    assert find("", np.empty((NUM_FRAMES, 0, 3))) == set()


LIMBS = {"arm": ("ELB", "WRA", "WRB", "FIN"), "leg": ("KNE", "TIB", "ANK", "HEE", "TOE")}


def limb(label: str) -> str | None:
    """Return the limb of a marker of the sample take, such as "L arm"; None for other parts of the body."""
    names = [name for name, ends in LIMBS.items() if label[1:] in ends]
    return f"{label[0]} {names[0]}" if names else None


def test_the_person_of_the_sample_take_becomes_a_stick_figure() -> None:
    """No link joins two limbs."""
    markers = open_take(ROOT / "examples/walk.lcmlog").sources["lab"].markers
    assert markers is not None
    positions = np.stack([markers.items[axis] for axis in "xyz"], axis=-1)
    links = find(markers.labels, positions[::6])
    assert len(links) == 31
    for link in links:
        first, second = (limb(markers.labels[marker]) for marker in link)
        assert first == second or None in {first, second}
