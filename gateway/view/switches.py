"""The tab "Scene" of the panel: what is shown, and how."""

from collections.abc import Callable
from typing import Any, Final

import viser

from gateway.descriptions.plate_forces import METRES_PER_NEWTON
from gateway.view.axes import UP_AXES, UpAxis
from gateway.view.colors import SourceColor
from gateway.view.server import set_theme

_LEGEND: Final = (
    f"<div class=gateway>Yellow arrows are forces: 1 m for {1 / METRES_PER_NEWTON:.0f} N. Axes are tools: "
    "red x, green y, blue z. What is grey is not live.</div>"
)


class Switches:
    """The switches of the scene, common to all browsers. ``fit`` is called with the browser that wants it."""

    def __init__(
        self, server: viser.ViserServer, tab: viser.GuiTabHandle, fit: Callable[[viser.ClientHandle], object]
    ) -> None:
        self._server = server
        self._tab = tab
        with tab:
            button = server.gui.add_button("Fit view", hint="Turn the camera so that it sees all data.")
            self._marker_labels = server.gui.add_checkbox("Marker labels", initial_value=False)
            self._tool_labels = server.gui.add_checkbox("Tool labels", initial_value=True)
            self._trails = server.gui.add_checkbox("Marker trails", initial_value=False)
            self._floor = server.gui.add_checkbox("Floor", initial_value=True)
            self._up = server.gui.add_dropdown(
                "Up axis", UP_AXES, initial_value="z", hint="The axis of the laboratory that points up."
            )
            themes = server.gui.add_button_group("Background", ("dark", "light"))
            self._group = server.gui.add_folder("Sources")
            server.gui.add_html(_LEGEND)
        self.has_chosen_up = False
        """Whether somebody has chosen the axis that points up."""

        @button.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                fit(event.client)

        @self._up.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[UpAxis]]) -> None:
            self.has_chosen_up |= event.client is not None

        @themes.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                set_theme(event.client.gui, dark=themes.value == "dark")

    @property
    def marker_labels(self) -> bool:
        """Whether markers have labels."""
        return self._marker_labels.value

    @property
    def tool_labels(self) -> bool:
        """Whether tools have labels."""
        return self._tool_labels.value

    @property
    def trails(self) -> bool:
        """Whether markers have trails."""
        return self._trails.value

    @property
    def floor(self) -> bool:
        """Whether the floor is shown."""
        return self._floor.value

    @property
    def up(self) -> UpAxis:
        """The axis that points up; z if a page has sent anything else."""
        chosen = self._up.value
        return chosen if chosen in UP_AXES else "z"

    def suggest_up(self, up: UpAxis) -> None:
        """Choose the axis that points up, unless somebody has chosen it."""
        if not self.has_chosen_up:
            dropdown: Any = self._up  # viser's types do not know that its value can be set
            dropdown.value = up

    def add_source(self, name: str, color: SourceColor) -> viser.GuiCheckboxHandle:
        """Add the switch of a source, with a stripe in its colour."""
        with self._group:
            red, green, blue = color.rgb
            self._server.gui.add_html(
                f'<div style="margin: 0 0.8em; height: 3px; background: rgb({red}, {green}, {blue})"></div>'
            )
            return self._server.gui.add_checkbox(name, initial_value=True)
