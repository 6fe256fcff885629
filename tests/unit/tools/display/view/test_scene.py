"""The picture of a real viser server: what its nodes show, read back from the server."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import ForceChannel, Parameters, ParametersForce, Plate, Point
from gateway.tools.display.live import LiveComponent
from gateway.tools.display.view.camera import Subject
from gateway.tools.display.view.links import FIND_S, SAMPLE_US
from gateway.tools.display.view.scene import AXES_SHARE, ViewScene
from gateway.tools.display.view.scene_items import GHOST_S, LENGTH_S, MAX_LABELS, MAX_SEGMENTS
from gateway.tools.display.view.segments import MIN_FRAMES
from gateway.tools.display.view.tools import MAX_MOVED, MAX_TOOLS
from gateway.tools.display.view.viewer import ViewServer
from tests.support.errors import names
from tests.support.takes import START_UTIME, parameters
from tests.unit.tools.display.live_lab import MISSING, NAN, Lab

MARKERS, TOOLS, FORCE = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.FORCE
PLATE = Plate(
    "1",
    "Left",
    corners=(Point(400, 600, 0), Point(0, 600, 0), Point(0, 0, 0), Point(400, 0, 0)),
    channels=tuple(ForceChannel(str(each), unit="N" if each < 3 else "Nmm") for each in range(6)),
)


class Picture:
    """A scene, the sources that it shows, and a clock that tests move."""

    def __init__(self, server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> None:
        self._server = server
        self.now_s = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        self.scene = ViewScene(server, server.gui.add_tab_group())
        self.labs: list[Lab] = []

    def lab(self, name: str = "lab") -> Lab:
        lab = Lab(name)
        self.labs.append(lab)
        return lab

    def show(self, seconds: float = 0.0) -> None:
        """Show the picture ``seconds`` later."""
        self.now_s += seconds
        self.scene.update([lab.source for lab in self.labs], {})

    def show_parameters(self, lab: Lab, plate: Plate) -> None:
        """Show a plate that parameters describe."""
        _, message = parameters(Parameters(force=ParametersForce((plate,))))
        lab.live.publish(lab.name, "parameters", message)
        self.show()

    def node(self, path: str, source: str = "MOCAP_LAB") -> Any:
        return self._server.scene.get_handle_by_name(f"/sources/{source}/{path}".rstrip("/"))

    def points(self, path: str, source: str = "MOCAP_LAB") -> list[list[float]]:
        points = self.node(path, source).points
        return [[round(float(value), 4) for value in point] for point in points.reshape(-1, 3)]

    @property
    def up(self) -> str:
        return self.scene._world.up

    def switch(self, name: str, value: object) -> None:
        switch = getattr(self.scene._switches, "_up" if name == "up" else name)
        switch.value = value

    def tools(self, source: str = "MOCAP_LAB") -> dict[str, list[float]]:
        """Return where the visible tools are, by their labels."""
        nodes = {index: self.node(f"tools/{index}", source) for index in range(MAX_TOOLS)}
        return {
            self.node(f"tools labels/{index}", source).text: [
                round(float(value), 4) for value in node.position
            ]
            for index, node in nodes.items()
            if node is not None and node.visible
        }

    def switch_source(self, value: bool, source: str = "MOCAP_LAB") -> None:
        switch: Any = self.scene._sources[source]._switch
        switch.value = value

    def shown_labels(self, path: str, source: str = "MOCAP_LAB") -> dict[str, list[float]]:
        nodes = [self.node(f"{path}/{index}", source) for index in range(MAX_LABELS + 1)]
        return {
            node.text: [round(float(value), 4) for value in node.position]
            for node in nodes
            if node is not None and node.visible
        }


@pytest.fixture
def picture(server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> Picture:
    return Picture(server, monkeypatch)


def test_a_missing_marker_is_absent_and_its_last_place_is_shown_for_a_second(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0), (0, 500, 0, 0)])
    picture.show()
    assert picture.points("missing markers") == []
    for _ in range(9):
        lab.send(MARKERS, [MISSING, (0, 600, 0, 0)])
        picture.show(GHOST_S / 10)
        assert picture.points("markers") == [[0, 0.6, 0]]
        assert picture.points("missing markers") == [[0.5, 0, 0]]
    lab.send(MARKERS, [MISSING, (0, 600, 0, 0)])
    picture.show(GHOST_S / 5)
    assert picture.points("missing markers") == []
    lab.send(MARKERS, [(700, 0, 0, 0), (0, 600, 0, 0)])
    picture.show()
    assert picture.points("markers") == [[0.7, 0, 0], [0, 0.6, 0]]


def test_markers_are_where_the_data_say_in_metres_and_stay_there_between_two_frames(picture: Picture) -> None:
    picture.lab().send(MARKERS, [(500, -250, 1000, 0), (1, 2, 3, 0)])
    for _ in range(2):
        picture.show(0.1)
        assert picture.points("markers") == [[0.5, -0.25, 1.0], [0.001, 0.002, 0.003]]
        assert picture.points("missing markers") == []


def test_other_markers_have_no_last_places_of_former_ones(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0), (0, 0, 0, 0)])
    picture.show()
    lab.send_parameters("<The_3D><Markers>2</Markers><Marker><Label>A</Label></Marker></The_3D>")
    lab.send(MARKERS, [MISSING, (0, 0, 0, 0)])
    picture.show(0.1)
    assert picture.points("missing markers") == []
    lab.send(MARKERS, [(1000, 0, 0, 0)] * 5)
    picture.show(0.1)
    assert len(picture.points("markers")) == 5


def test_all_data_have_stopped_though_of_a_component_nothing_has_come(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0)])
    lab.source.components["6d"] = LiveComponent(ComponentType.TOOLS)
    picture.show()
    picture.show(3.0)
    assert names(picture.node("stopped").text, "lab", "data", "3 s")


def test_data_that_stop_are_grey_and_the_picture_says_so(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0)])
    lab.send(TOOLS, [(1, 0, 0, 0, 0, 0, 500, 0)])
    picture.show()
    live = picture.node("markers").colors.tolist()
    assert not picture.node("stopped").visible
    picture.show(3.0)
    assert picture.node("markers").colors.tolist() == [128, 128, 128]
    assert picture.node("stopped").text == "lab: no data for 3 s"
    assert picture.node("stopped").visible
    assert np.unique(picture.node("tools/0/axes").colors).tolist() == [128]
    lab.send(TOOLS, [(1, 0, 0, 0, 0, 0, 500, 0)])
    picture.show()
    assert names(picture.node("stopped").text, "lab", "markers", "3 s")
    lab.send(MARKERS, [(500, 0, 0, 0)])
    picture.show()
    assert picture.node("markers").colors.tolist() == live
    assert not picture.node("stopped").visible


def test_markers_have_labels_on_demand(picture: Picture) -> None:
    lab = picture.lab()
    lab.send_parameters(
        "<The_3D><Markers>2</Markers><Marker><Label>LASI</Label></Marker>"
        "<Marker><Label>RASI</Label></Marker></The_3D>"
    )
    lab.send(MARKERS, [(500, 0, 0, 0), MISSING])
    picture.show()
    assert picture.node("marker labels/0") is None
    picture.switch("marker_labels", True)
    picture.show(0.1)
    assert picture.shown_labels("marker labels") == {"LASI": [0.5, 0, 0]}
    lab.send(MARKERS, [(600, 0, 0, 0), (0, 0, 100, 0)])
    picture.show(0.1)
    assert picture.shown_labels("marker labels") == {"LASI": [0.6, 0, 0], "RASI": [0, 0, 0.1]}
    lab.send_parameters("<The_3D><Markers>1</Markers><Marker><Label>HEAD</Label></Marker></The_3D>")
    lab.send(MARKERS, [(600, 0, 0, 0)])
    picture.show(0.1)
    assert picture.shown_labels("marker labels") == {"HEAD": [0.6, 0, 0]}
    picture.switch("marker_labels", False)
    picture.show(0.1)
    assert not picture.node("marker labels").visible


def test_the_number_of_labels_and_their_cost_are_bounded(picture: Picture, server: ViewServer) -> None:
    lab = picture.lab()
    picture.switch("marker_labels", True)
    picture.switch("trails", True)
    positions = np.arange(40_000, dtype=float).reshape(10_000, 4)
    for _ in range(20):
        positions[:, 0] += 10
        lab.send(MARKERS, [*map(tuple, positions.tolist())])
        picture.show(0.1)
    assert len(picture.points("markers")) == 10_000
    assert len(picture.shown_labels("marker labels")) == MAX_LABELS
    assert len(picture.node("trails").points) <= MAX_SEGMENTS
    messages = server._connection.get_message_buffer().message_counter
    lab.send(MARKERS, [*map(tuple, positions.tolist())])
    picture.show(0.1)
    assert server._connection.get_message_buffer().message_counter - messages < 100


def test_trails_follow_markers_and_are_interrupted_where_one_was_missing(picture: Picture) -> None:
    lab = picture.lab()
    picture.switch("trails", True)
    for x in (0, 100, NAN, 300, 400):
        lab.send(MARKERS, [(x, 0, 0, 0)])
        picture.show(0.1)
    assert picture.points("trails") == [[0, 0, 0], [0.1, 0, 0], [0.3, 0, 0], [0.4, 0, 0]]
    lab.send(MARKERS, [(400, 0, 0, 0)])
    picture.show(LENGTH_S)
    assert picture.points("trails") == [[0.4, 0, 0], [0.4, 0, 0]]
    picture.switch("trails", False)
    picture.show(0.1)
    assert picture.points("trails") == []


def test_links_join_markers_that_keep_their_distance_while_they_move(picture: Picture) -> None:
    lab = picture.lab()
    for number in range(2 * MIN_FRAMES):
        x = 100 * (number % 3)
        items = [(x, 0, 0, 0), (x, 200, 0, 0), (0, 0, 900, 0)]
        lab.send(MARKERS, items, utime=START_UTIME + number * SAMPLE_US)
        picture.show(FIND_S)
    lab.send(MARKERS, [(0, 0, 0, 0), (0, 200, 0, 0), (0, 0, 900, 0)])
    picture.show()
    assert picture.points("links 0") == [[0, 0, 0], [0, 0.2, 0]]
    picture.switch("links", False)
    picture.show()
    assert picture.points("links 0") == []


def test_tools_are_axes_with_labels_and_missing_ones_are_hidden(picture: Picture) -> None:
    lab = picture.lab()
    turned = (0.5, 0.5, 0.5, 0.5, 100, 200, 300, 0)
    lab.send(TOOLS, [turned, (NAN,) * 8, (0, 0, 0, 0, 1, 1, 1, 0), (2, 0, 0, 0, 0, 0, 0, 0)])
    picture.show()
    picture.show(0.1)
    assert picture.tools() == {"tool 1": [0.1, 0.2, 0.3], "tool 4": [0, 0, 0]}
    assert picture.shown_labels("tools labels") == picture.tools()
    assert picture.node("tools/0").wxyz == pytest.approx([0.5] * 4)
    assert picture.node("tools/3").wxyz.tolist() == [1, 0, 0, 0]
    lab.send(TOOLS, [turned] * 2)
    picture.show(0.1)
    assert picture.tools().keys() == {"tool 1", "tool 2"}
    lab.send(TOOLS, [])
    picture.show(0.1)
    assert picture.tools() == {}


def test_more_tools_than_are_moved_at_a_time_are_moved_in_turns(picture: Picture, server: ViewServer) -> None:
    lab = picture.lab()
    for number in range(9):
        lab.send(TOOLS, [(1, 0, 0, 0, 1000 + number, 0, 0, 0)] * (MAX_TOOLS + 10))
        picture.show(0.1)
    messages = server._connection.get_message_buffer()
    lab.send(TOOLS, [(1, 0, 0, 0, 5000, 0, 0, 0)] * (MAX_TOOLS + 10))
    before = messages.message_counter
    for number in range(1, 4):
        picture.show(0.1)
        moved = sum(picture.node(f"tools/{index}").position[0] == 5 for index in range(MAX_TOOLS))
        assert moved == number * MAX_MOVED
    assert messages.message_counter - before < 3 * 3 * MAX_MOVED + 100
    assert picture.node(f"tools/{MAX_TOOLS}") is None


def test_the_axes_of_tools_grow_with_the_distance_of_the_camera(picture: Picture) -> None:
    """At 5 m, axes of a fixed size were a few pixels long."""
    lab = picture.lab()
    lab.send(TOOLS, [(1, 0, 0, 0, 0, 0, 0, 0)])
    for distance_m in (5.0, 20.0):
        picture.scene._cameras.distance_m = distance_m
        picture.show()
        assert picture.node("tools/0/axes").points.max() == pytest.approx(AXES_SHARE * distance_m)


def test_a_plate_is_where_the_parameters_say_and_its_arrow_at_the_centre_of_pressure(
    picture: Picture,
) -> None:
    lab = picture.lab()
    picture.show_parameters(lab, PLATE)
    lab.send(FORCE, [(0, 100, 500, 500 * 50, 0, 0)])  # 50 mm from the centre, which is at (200, 300) mm
    picture.show()
    picture.show(0.1)
    corners = {tuple(point) for point in picture.points("plates")}
    assert corners == {(0.4, 0.6, 0), (0, 0.6, 0), (0, 0, 0), (0.4, 0, 0)}
    assert picture.shown_labels("plate labels") == {"Left": [0.2, 0.3, 0]}
    assert picture.points("forces") == [[0.2, 0.35, 0], [0.2, 0.45, 0.5]]
    assert picture.shown_labels("force values") == {"510 N": [0.2, 0.45, 0.5]}
    lab.send(FORCE, [(0, 0, 5, 0, 0, 0)])  # it lifts off
    picture.show(0.1)
    assert picture.shown_labels("force values") == {}


def test_the_mark_for_1_m_says_how_long_arrows_are_only_where_there_are_plates(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0)])
    picture.show()
    assert picture.scene._world._unit.text == "1 m"
    picture.show_parameters(lab, PLATE)
    assert picture.scene._world._unit.text == "1 m = 1000 N"


def test_two_sources_with_the_same_plates_have_labels_that_differ(picture: Picture) -> None:
    for name in ("gym", "lab"):
        picture.show_parameters(picture.lab(name), PLATE)
    picture.show(0.1)
    picture.show(0.1)
    assert picture.shown_labels("plate labels", "MOCAP_GYM") == {"gym: Left": [0.2, 0.3, 0]}
    assert picture.shown_labels("plate labels") == {"lab: Left": [0.1, 0.45, 0]}


def test_the_label_of_a_stop_is_above_what_has_stopped_not_in_the_middle_of_everything(
    picture: Picture,
) -> None:
    """Another source's subject may stand between the markers and the plates."""
    lab = picture.lab()
    picture.show_parameters(lab, PLATE)
    lab.send(MARKERS, [(5000, 0, 0, 0), (5000, 0, 1800, 0)])
    picture.show()
    picture.show(3.0)
    assert picture.node("stopped").position == pytest.approx((5.0, 0.0, 1.8))


def test_the_camera_is_fitted_to_plates_and_again_when_somebody_comes_or_a_source_is_switched(
    picture: Picture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A take, or a measurement, may begin after the page was opened."""
    subjects: list[tuple[Subject, int]] = []
    monkeypatch.setattr(
        picture.scene._cameras,
        "update",
        lambda _clients, subject, points, _now_s: subjects.append((subject, sum(map(len, points())))),
    )
    lab = picture.lab()
    picture.show_parameters(lab, PLATE)
    lab.send(MARKERS, [(5000, 0, 0, 0), (5000, 0, 1800, 0)])
    picture.show()
    picture.switch_source(False)
    picture.show()
    assert subjects == [
        (Subject("z", ("MOCAP_LAB",), 0), 4),
        (Subject("z", ("MOCAP_LAB",), 1), 4 + 2),
        (Subject("z", (), 0), 0),
    ]


def test_the_up_axis_is_that_of_the_plates_until_somebody_chooses(picture: Picture) -> None:
    wall = replace(PLATE, corners=(Point(0, 0, 600), Point(0, 0, 0), Point(400, 0, 0), Point(400, 0, 600)))
    picture.show_parameters(picture.lab(), wall)
    assert picture.up == "y"
    for chosen, up in (("x", "x"), ("no axis", "z")):  # no page of ours sends the second one
        picture.switch("up", chosen)
        picture.show()
        assert picture.up == up


def test_plates_without_a_known_place_stand_at_the_origin_and_say_so(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(FORCE, [(0, 0, 1000, 0, 0, 0), (0, 0, 5, 0, 0, 0), (NAN, 0, 1000, 0, 0, 0)])
    picture.show()
    picture.show(0.1)
    assert len(picture.points("plates")) == 3 * 4 * 2
    assert picture.shown_labels("plate labels").keys() == {
        f"plate {number} (place unknown)" for number in (1, 2, 3)
    }
    assert picture.points("forces") == [[0, 0, 0], [0, 0, 1]]
    live = picture.node("forces").colors.tolist()
    picture.show(3.0)
    assert picture.points("forces") == [[0, 0, 0], [0, 0, 1]]
    assert picture.node("forces").colors.tolist() == [128, 128, 128] != live


@pytest.mark.parametrize("value", [1e30, -1e30, 3e38, np.inf, -np.inf, NAN])
def test_absurd_values_are_not_shown(picture: Picture, value: float) -> None:
    lab = picture.lab()
    picture.switch("marker_labels", True)
    picture.switch("trails", True)
    for _ in range(3):
        lab.send(MARKERS, [(value, 0, 0, 0), (0, value, value, value)])
        lab.send(TOOLS, [(value, value, 0, 0, 0, 0, 0, 0), (1, 0, 0, 0, value, 0, 0, value)])
        lab.send(FORCE, [(value,) * 6, (0, 0, value, 0, 0, 0), (0, 0, 1000, value, 0, 0)])
        picture.show(0.1)
    assert picture.points("markers") == []
    forces = picture.node("forces").points
    assert "tool 2" not in picture.tools()
    assert np.isfinite(picture.node("tools/0").wxyz).all()
    assert np.isfinite(forces).all()
    assert abs(forces).max(initial=0) < 10


def test_each_source_has_a_group_a_colour_and_a_switch(picture: Picture) -> None:
    for lab in (picture.lab("gym"), picture.lab("lab")):
        lab.send(MARKERS, [(500, 0, 0, 0)])
    picture.show()
    assert picture.node("markers", "MOCAP_GYM").colors.tolist() != picture.node("markers").colors.tolist()
    gym, lab_scene = picture.scene._sources.values()
    switch: Any = gym._switch
    switch.value = False
    picture.show()
    assert (gym.group.visible, lab_scene.group.visible) == (False, True)


def test_old_data_are_hidden_while_nobody_looks(picture: Picture) -> None:
    lab = picture.lab()
    lab.send(MARKERS, [(500, 0, 0, 0)])
    picture.show()
    picture.scene.pause()
    assert not picture.node("").visible
    lab.send(MARKERS, [(600, 0, 0, 0)])
    picture.show(60.0)
    assert picture.node("").visible
    assert picture.points("markers") == [[0.6, 0, 0]]
