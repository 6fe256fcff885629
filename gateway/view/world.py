"""The floor, the axes of the laboratory and their unit."""

from typing import Final

import numpy as np
import viser

from gateway.descriptions.plate_forces import METRES_PER_NEWTON
from gateway.takes.component_rows import Array
from gateway.view.axes import PLANES, UP_AXES, UpAxis, on_floor
from gateway.view.colors import GREY

_AXIS_M: Final = 0.5
_GRID_M: Final = 10.0
_LINE_COLOR: Final = (110, 115, 125)


class World:
    """What does not move. ``up`` is the axis that points up."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        server.scene.configure_default_lights(cast_shadow=False)  # shadows cost browsers more than all else
        self._grids = {axis: self._add_grid(axis) for axis in UP_AXES}
        server.scene.add_frame("/world/axes", axes_length=_AXIS_M, axes_radius=0.006, origin_radius=0.012)
        for axis, place in zip("xyz", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True):
            position = (_AXIS_M * place[0], _AXIS_M * place[1], _AXIS_M * place[2])
            server.scene.add_label(f"/world/{axis}", axis, position=position, anchor="bottom-center")
        self._unit = server.scene.add_label(
            "/world/unit", "1 m", anchor="center-center", font_screen_scale=0.8
        )
        self.up: UpAxis = "z"
        self.set_up("z")

    def set_up(self, up: UpAxis) -> None:
        """Turn the picture so that this axis points up."""
        self.up = up
        direction = on_floor(up, 0.0, 0.0, 1.0)
        self._server.scene.set_up_direction(direction)
        for axis, grid in self._grids.items():
            grid.visible = axis == up
        self._unit.position = on_floor(up, 1.0, 0.0)

    @property
    def mark(self) -> Array:
        """Where the mark for 1 m is, shape (1, 3)."""
        return np.array([self._unit.position])

    def show_scale(self, *, forces: bool) -> None:
        """Say at the mark for 1 m how much force an arrow of this length is, if there are ``forces``."""
        self._unit.text = f"1 m = {1 / METRES_PER_NEWTON:.0f} N" if forces else "1 m"

    def show_floor(self, *, visible: bool) -> None:
        """Show or hide the floor."""
        self._grids[self.up].visible = visible

    def _add_grid(self, axis: UpAxis) -> viser.GridHandle:
        return self._server.scene.add_grid(
            f"/world/floor {axis}",
            _GRID_M,
            _GRID_M,
            plane=PLANES[axis],
            cell_size=0.25,
            cell_color=GREY,
            cell_thickness=0.4,
            section_size=1.0,
            section_color=_LINE_COLOR,
            section_thickness=1.0,
            fade_distance=15.0,
            shadow_opacity=0.0,
            visible=False,
        )
