"""What one source has in the picture."""

from collections.abc import Iterable
from typing import Final
from urllib.parse import quote

import numpy as np
import viser

from gateway.live.component import LiveComponent
from gateway.live.live_data import LiveSource
from gateway.view.axes import UpAxis, on_floor
from gateway.view.camera import Sphere, sphere_around
from gateway.view.colors import color_of
from gateway.view.markers import Markers
from gateway.view.plates import Plates
from gateway.view.switches import Switches
from gateway.view.tools import Tools

_NAMES: Final = {"3d": "markers", "6d": "tools", "force": "forces", "analog": "analog data"}

_GAP_M: Final = 0.2
"""How much higher the label of each further source is that says that its data have stopped."""


class SourceScene:
    """The markers, tools, plates and forces of a source, in a group of their own.

    ``number`` is the source's: it has a colour of its own, and its labels are not where others have theirs.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        source: LiveSource,
        number: int,
        switch: viser.GuiCheckboxHandle,
    ) -> None:
        self._number = number
        color = color_of(number)
        self._name = source.name
        self._switch = switch
        scene = server.scene
        path = f"/sources/{quote(source.channels, safe='')}"
        self._group = scene.add_frame(path, show_axes=False)
        self._markers = Markers(scene, path, color)
        self._tools = Tools(scene, path)
        self._plates = Plates(scene, path, number)
        self._stopped = scene.add_label(
            f"{path}/stopped", "", visible=False, font_screen_scale=1.6, anchor="bottom-center"
        )

    def update(
        self, source: LiveSource, up: UpAxis, switches: Switches, now_s: float, *, is_alone: bool
    ) -> None:
        """Show the newest data of the source. If it is not alone, its labels begin with its name."""
        if source.name != self._name:  # on LCM, a status says the name
            self._name = source.name
            self._switch.label = source.name
        self._group.visible = self._switch.value
        if not self._group.visible:
            return
        components = {**source.components}
        prefix = "" if is_alone else f"{source.name}: "
        if "3d" in components:
            self._markers.update(
                components["3d"], now_s, prefix, labels=switches.marker_labels, trails=switches.trails
            )
        if "6d" in components:
            self._tools.update(components["6d"], now_s, prefix, labels=switches.tool_labels)
        self._plates.update(components.get("force"), source.newest_parameters, up, now_s, prefix)
        self._say_stopped(source.name, components, up)

    def hide(self) -> None:
        """Hide everything until the next update."""
        self._group.visible = False

    @property
    def is_visible(self) -> bool:
        """Whether its switch is on."""
        return bool(self._group.visible)

    @property
    def has_subject(self) -> bool:
        """Whether markers or tools are in the picture."""
        return sphere_around([self._markers.positions, self._tools.positions]) is not None

    @property
    def has_plates(self) -> bool:
        """Whether force plates are shown."""
        return self.is_visible and len(self._plates.corners) > 0

    @property
    def points(self) -> list[np.ndarray]:
        """The positions of everything, each of shape (points, 3), in metres; NaN is missing."""
        return [self._markers.positions, self._tools.positions, self._plates.corners]

    def _say_stopped(self, name: str, components: dict[str, LiveComponent], up: UpAxis) -> None:
        stopped = {key: each for key, each in components.items() if each.is_stopped}
        self._stopped.visible = bool(stopped)
        if not stopped:
            return
        age_s = max(each.age_s or 0.0 for each in stopped.values())
        self._stopped.text = f"{name}: no {_what(stopped, components)} for {_duration(age_s)}"
        # Above its own subject: between that and its plates, another source's subject may be.
        sphere = sphere_around([self._markers.positions, self._tools.positions])
        sphere = sphere or sphere_around([self._plates.corners]) or Sphere((0.0, 0.0, 0.0), 0.0)
        above = on_floor(up, 0.0, 0.0, sphere.radius + _GAP_M * self._number)
        x, y, z = np.add(sphere.centre, above).tolist()
        self._stopped.position = (x, y, z)


def _what(stopped: Iterable[str], components: dict[str, LiveComponent]) -> str:
    """Return what does not come, such as "markers and forces"."""
    expected = [key for key in _NAMES if key in components]
    names = [_NAMES[key] for key in expected if key in stopped]
    if len(names) == len(expected):
        return "data"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"
