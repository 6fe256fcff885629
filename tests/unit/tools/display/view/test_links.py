"""The lines between markers in the scene of a real viser server, read back from it."""

import math

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.tools.display.live import DisplayedSource
from gateway.tools.display.view.links import FIND_S, SAMPLE_US, Links
from gateway.tools.display.view.scene_items import GREY, color_of, positions_in_metres
from gateway.tools.display.view.segments import MAX_MARKERS, MIN_FRAMES
from gateway.tools.display.view.viewer import ViewServer
from tests.unit.tools.display.live_lab import MISSING, Lab, wait

PLACES_MM = (0.0, 100.0, 300.0)
STEP_MM = 100.0


class Walk:
    """Markers on a line that walks along itself, one step in each sample, and the links of them."""

    def __init__(self, server: ViewServer, lab: Lab, number: int = 0) -> None:
        self._server = server
        self.lab = lab
        self.links = Links(server.scene, "/lab", number)
        self.missing: set[int] = set()
        self.x_mm = 0.0
        self.now_s = 0.0
        self.utime = 1_700_000_000_000_000

    def send(self, num_frames: int, *places_mm: float, period_us: int = SAMPLE_US) -> None:
        """Send frames with markers at these places of the line."""
        for _ in range(num_frames):
            self.x_mm += STEP_MM * period_us / SAMPLE_US
            self.utime += period_us
            items = [
                MISSING if number in self.missing else (self.x_mm + place_mm, 0, 0, 0)
                for number, place_mm in enumerate(places_mm)
            ]
            self.lab.send(ComponentType.MARKERS, items, utime=self.utime)

    def show(self, *, shown: bool = True) -> list[list[list[float]]]:
        """Show what was sent, later; return the lines, from the first marker's place on, in mm."""
        self.now_s += FIND_S
        return self.draw(self.lab.source, shown=shown)

    def draw(self, source: DisplayedSource, *, shown: bool = True) -> list[list[list[float]]]:
        """Show the newest frame of the source."""
        component = source.components["3d"]
        positions = positions_in_metres(component.newest_items, "mm")
        self.links.update(component, positions, self.now_s, shown=shown)
        lines = [line for index in range(9) for line in self.node_lines(index)]
        return [[[round(1000 * point[0] - self.x_mm), *point[1:]] for point in line] for line in lines]

    def node_lines(self, index: int) -> list[list[list[float]]]:
        node = self._server.scene.get_handle_by_name(f"/lab/links {index}")
        return [] if node is None else node.points.tolist()  # type: ignore[attr-defined]  # it is a node of lines

    def color(self, index: int) -> tuple[int, ...]:
        node = self._server.scene.get_handle_by_name(f"/lab/links {index}")
        return tuple(node.colors.tolist())  # type: ignore[union-attr]  # they are an array


def line(first_mm: float, second_mm: float) -> list[list[float]]:
    return [[first_mm, 0, 0], [second_mm, 0, 0]]


@pytest.fixture
def walk(server: ViewServer, lab: Lab) -> Walk:
    return Walk(server, lab)


def test_lines_join_the_markers_of_a_segment_once_it_has_moved(walk: Walk) -> None:
    walk.send(1, *PLACES_MM)
    for _ in range(MIN_FRAMES - 1):
        walk.send(1, *PLACES_MM)
        assert walk.show() == []
    walk.send(1, *PLACES_MM)
    assert walk.show() == [line(0, 100), line(100, 300)]


def test_a_line_is_hidden_while_a_marker_is_missing_and_back_at_once(walk: Walk) -> None:
    walk.send(2 * MIN_FRAMES, *PLACES_MM)
    walk.show()
    walk.missing = {2}
    walk.send(1, *PLACES_MM)
    assert walk.show() == [line(0, 100)]
    walk.missing = set()
    walk.send(1, *PLACES_MM)
    walk.now_s -= FIND_S  # so there is no search
    assert walk.show() == [line(0, 100), line(100, 300)]


def test_lines_are_shown_on_demand_and_at_once(walk: Walk) -> None:
    walk.send(2 * MIN_FRAMES, *PLACES_MM)
    assert walk.show(shown=False) == []
    assert walk.draw(walk.lab.source) == [line(0, 100), line(100, 300)]


def test_frames_between_two_samples_are_no_evidence(walk: Walk) -> None:
    """At 200 Hz, the frames of half a second would be enough, and who moves one joint only would be stiff."""
    for _ in range(MIN_FRAMES - 1):
        walk.send(25, *PLACES_MM, period_us=SAMPLE_US // 25)
        assert walk.show() == []
    walk.send(50, *PLACES_MM, period_us=SAMPLE_US // 25)
    assert len(walk.show()) == 2


def test_links_are_searched_for_at_intervals(walk: Walk) -> None:
    walk.send(1, *PLACES_MM)
    walk.show()
    walk.send(2 * MIN_FRAMES, *PLACES_MM)
    walk.now_s += FIND_S / 2
    assert walk.draw(walk.lab.source) == []
    walk.now_s += FIND_S / 2
    assert len(walk.draw(walk.lab.source)) == 2


def test_each_subject_has_a_colour_and_the_first_that_of_its_source(server: ViewServer, lab: Lab) -> None:
    walk = Walk(server, lab, number=1)
    lab.send_labels("Ann:A", "Ben:A", "Ben:B", "Ann:B")
    walk.send(2 * MIN_FRAMES, 0, 100, 200, 300)
    walk.show()
    assert [len(walk.node_lines(index)) for index in (0, 1)] == [1, 1]
    lines = [walk.node_lines(index)[0] for index in (0, 1)]
    lengths = [round(1000 * (second[0] - first[0])) for first, second in lines]
    assert lengths == [300, 100]
    assert [walk.color(index) for index in (0, 1)] == [color_of(1), color_of(2)]


def test_lines_are_grey_while_data_have_stopped(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    walk.send(2 * MIN_FRAMES, *PLACES_MM)
    walk.show()
    assert walk.color(0) == color_of(0)
    wait(monkeypatch, 60.0)
    assert len(walk.show()) == 2
    assert walk.color(0) == GREY
    walk.send(1, *PLACES_MM)
    walk.show()
    assert walk.color(0) == color_of(0)


def test_other_markers_do_not_inherit_links(walk: Walk) -> None:
    walk.send(2 * MIN_FRAMES, *PLACES_MM)
    assert len(walk.show()) == 2
    walk.lab.send_labels("A", "B", "C")
    walk.send(1, *PLACES_MM)
    walk.now_s -= FIND_S
    assert walk.show() == []
    walk.send(1, 0)
    assert walk.show() == []
    walk.send(2 * MIN_FRAMES, 0, 500)
    assert walk.show() == [line(0, 500)]


def test_many_subjects_and_absurd_positions_are_harmless(walk: Walk) -> None:
    num_markers = 400
    walk.lab.send_labels(*(f"S{number % 200}:M{number}" for number in range(num_markers)))
    for value in (0.0, 3e38, math.inf, 100.0) * MIN_FRAMES:
        walk.send(1, *[value] * num_markers)
        walk.show()
    walk.send(1, *[0.0] * num_markers)
    assert len(walk.show()) == MAX_MARKERS - 200
    assert walk.node_lines(5)
    assert walk.node_lines(6) == []
