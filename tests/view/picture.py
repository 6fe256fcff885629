"""What the page of ``view`` shows: the nodes of the scene, where they are on the screen, and pixels."""

import io
import math
import re
import time
from collections.abc import Callable, Collection
from typing import Any, Final

import numpy as np
from PIL import Image
from playwright.sync_api import FloatRect, Page

from gateway.takes.files.component_rows import Array

Position = tuple[float, float, float]

TIMEOUT_MS: Final = 180_000
"""Chromium that renders in software takes a while on a busy computer."""

_NODES: Final = "() => window.__viserSceneTree?.getState() ?? {}"

_HAS_POINTS: Final = """(nodes, [pattern, wanted]) => {
    const points = [];
    for (const [name, node] of Object.entries(nodes)) {
        if (!new RegExp(`^(${pattern})$`).test(name) || !node.effectiveVisibility) continue;
        const values = node.message.props.points;
        for (let i = 0; i < values.length; i += 3) points.push(values.slice(i, i + 3));
    }
    const isAt = (point, place) => place.every((value, axis) => Math.abs(1000 * point[axis] - value) < 1);
    return points.length === wanted.length && wanted.every(place => points.some(point => isAt(point, place)));
}"""

_HAS_LABELS: Final = """(nodes, wanted) => {
    const labels = Object.entries(nodes)
        .filter(([name, node]) => /marker labels\\/\\d+$/.test(name) && node.effectiveVisibility);
    const isAt = (name, place) => {
        const position = window.__viserMutable.nodePoseData[name]?.position;
        return position && place && place.every((value, axis) => Math.abs(1000 * position[axis] - value) < 5);
    };
    return labels.length === Object.keys(wanted).length
        && labels.every(([name, node]) => isAt(name, wanted[node.message.props.text]));
}"""

_HAS_TEXT: Final = """(nodes, pattern) => Object.values(nodes).some(
    node => node.effectiveVisibility && new RegExp(pattern).test(node.message.props?.text)
)"""

_ON_SCREEN: Final = """([node, positions]) => {
    const {camera, canvas, nodeRefFromName} = window.__viserMutable;
    const object = nodeRefFromName[node];
    if (!object || !canvas) return null;
    object.updateWorldMatrix(true, false);
    const {left, top, width, height} = canvas.getBoundingClientRect();
    return positions.map(position => {
        const point = camera.position.clone().fromArray(position.map(value => value / 1000))
            .applyMatrix4(object.matrixWorld).project(camera);
        return [left + (point.x + 1) / 2 * width, top + (1 - point.y) / 2 * height];
    });
}"""

_IS_FITTED: Final = """places => {
    const {innerWidth, innerHeight} = window;
    const [x, y] = [0, 1].map(axis => (places ?? []).map(place => place[axis]));
    return Math.min(...x) > 0 && Math.max(...x) < innerWidth
        && Math.min(...y) > 0 && Math.max(...y) < innerHeight
        && Math.max(...y) - Math.min(...y) > innerHeight / 3;
}"""

_NO_PANEL: Final = """
.mantine-Paper-root, .mantine-Paper-root *, .mantine-Notifications-root * { visibility: hidden !important }
"""


class Picture:
    """A page of ``view`` that has been opened.

    viser's page offers the scene for tests: ``__viserSceneTree`` has the nodes as the server described them,
    and ``__viserMutable`` the camera and the objects of three.js that are drawn.
    """

    def __init__(self, page: Page, address: str) -> None:
        self.page = page
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(address)
        page.wait_for_function("window.__viserMutable?.camera")

    def wait_for_view_of(self, node: str, positions: Collection[Position]) -> None:
        """Wait until the camera has moved to where these positions, in mm, fill the window."""
        self.page.wait_for_function(
            f"argument => ({_IS_FITTED})(({_ON_SCREEN})(argument))",
            arg=[node, [*positions]],
        )

    @property
    def camera_position(self) -> Position:
        """Where the camera is, in metres, on the axes of three.js."""
        x, y, z = self.page.evaluate("window.__viserMutable.camera.position.toArray()")
        return x, y, z

    def distance_to(self, position: Position) -> float:
        """Return how far the camera is from a position, in metres."""
        return math.dist(self.camera_position, position)

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Wait until a condition holds, while the page goes on."""
        deadline_s = time.monotonic() + TIMEOUT_MS / 1000
        while not condition():
            assert time.monotonic() < deadline_s, f"still not true after {TIMEOUT_MS / 1000:g} s"
            self.page.wait_for_timeout(20)

    def wait_for_points(self, pattern: str, positions: Collection[Position]) -> None:
        """Wait until the nodes whose names match show just these points, in mm and in any order."""
        self.wait_for(_HAS_POINTS, [pattern, [*positions]])

    def wait_for_number_of_points(self, node: str, count: int) -> None:
        """Wait until a node shows at least this many points."""
        self.wait_for(
            "(nodes, [node, count]) => nodes[node]?.effectiveVisibility"
            " && nodes[node].message.props.points.length >= 3 * count",
            [node, count],
        )

    def wait_for_labels(self, labels: dict[str, Position]) -> None:
        """Wait until markers have these labels, and no others, at these positions in mm."""
        self.wait_for(_HAS_LABELS, labels)

    def wait_for_labels_drawn_at(self, node: str, position: Position, count: int) -> None:
        """Wait until so many labels are drawn, each at another place within 0.4 m of a position in mm."""
        code = """([node, positions, count]) => {
            const {scene, nodeRefFromName} = window.__viserMutable, places = new Set();
            let data;
            scene.traverse(({material}) => { data ??= material?.uniforms?.uLabelData?.value.image.data; });
            const object = nodeRefFromName[node];
            if (!data || !object) return false;
            const place = object.position.clone().fromArray(positions[0].map(value => value / 1000));
            place.applyMatrix4(object.matrixWorld);
            let number = 0;
            for (let i = 0; i < data.length; i += 4) {
                const distances = [0, 1, 2].map(axis => data[i + axis] - place.getComponent(axis));
                if (!data[i + 3] || Math.hypot(...distances) > 0.4) continue;
                number++;
                places.add([0, 1, 2].map(axis => data[i + axis].toFixed(4)).join());
            }
            return number === count && places.size === count;
        }"""
        self.page.wait_for_function(code, arg=[node, [position], count])

    def wait_for_text(self, pattern: str) -> None:
        """Wait until a label in the picture says this."""
        self.wait_for(_HAS_TEXT, pattern)

    def wait_for_no_text(self, pattern: str) -> None:
        """Wait until no label in the picture says this."""
        self.wait_for(f"(nodes, pattern) => !({_HAS_TEXT})(nodes, pattern)", pattern)

    def wait_for_notice(self, text: str) -> None:
        """Wait until the notice across the top of the picture begins with a text; "" is no notice."""
        code = """text => {
            const notice = document.querySelector('.gateway-notice');
            if (!text) return notice.getClientRects().length === 0;
            return notice.innerText.startsWith(text) && notice.getBoundingClientRect().top === 0;
        }"""
        self.page.wait_for_function(code, arg=text)

    def wait_for_banner(self, text: str) -> None:
        """Wait until the banner at the top of the panel contains a text."""
        self.page.wait_for_function(
            "text => document.querySelector('.gateway')?.innerText.includes(text)", arg=text
        )

    def wait_for(self, expression: str, argument: object = None) -> None:
        """Wait until a JavaScript function returns true; ``nodes`` are the nodes of the scene by name."""
        code = f"argument => {{ const nodes = ({_NODES})(); return ({expression})(nodes, argument); }}"
        self.page.wait_for_function(code, arg=argument)

    @property
    def nodes(self) -> dict[str, Any]:
        """The nodes of the scene, by name: visibility, position and the properties the server set."""
        nodes: dict[str, Any] = self.page.evaluate(_NODES)
        return nodes

    def shown(self, pattern: str) -> dict[str, Any]:
        """Return the properties of the nodes that are shown and whose names match."""
        return {
            name: node["message"]["props"]
            for name, node in self.nodes.items()
            if re.fullmatch(pattern, name) and node["effectiveVisibility"]
        }

    def wait_for_drawn(self, node: str, position: Position, is_wanted: Callable[[Array], bool]) -> None:
        """Wait until a position, in mm in the coordinates of a node, is drawn in a wanted colour.

        The colour is red, green and blue from 0 to 255. Neither panel nor notices are before it.
        """
        colors: list[Array] = []

        def is_drawn() -> bool:
            places = self.page.evaluate(_ON_SCREEN, [node, [position]])
            if places is None:  # the page has not drawn the node yet
                return False
            [[x, y]] = places
            clip = FloatRect(x=round(x) - 1, y=round(y) - 1, width=3, height=3)
            pixels = Image.open(io.BytesIO(self.page.screenshot(style=_NO_PANEL, clip=clip))).convert("RGB")
            colors.append(np.asarray(pixels).mean(axis=(0, 1)))
            return is_wanted(colors[-1])

        try:
            self.wait_until(is_drawn)
        except AssertionError:
            raise AssertionError(f"{position} is drawn as {colors[-1:]}") from None
