"""Faults of the server as a whole: no measurement, another scene, other names, a restart."""

from collections.abc import Callable
from typing import ClassVar, Final

from gateway.simulator.faults.base import ActiveFault, Fault, LastingFault
from gateway.simulator.faults.parameters import Seconds
from gateway.simulator.scene_settings import Label, SceneSettings


class NoMeasurement(LastingFault):
    """The measurement stops; when the fault ends, a new one starts."""

    kind: ClassVar[str] = "no_measurement"

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        active.server.stop_measurement()
        return active.server.start_measurement


class ChangeScene(LastingFault):
    """Markers, tools and so on change during the measurement; when the fault ends, they change back."""

    kind: ClassVar[str] = "change_scene"

    scene: SceneSettings = SceneSettings(markers=12)
    """The changes to the scenario's scene; by default, it gets 12 markers."""

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        return active.server.change_scene(self.scene)


class Rename(LastingFault):
    """Somebody renames all markers and tools; when the fault ends, they have their former names."""

    kind: ClassVar[str] = "rename"

    prefix: Label = "New "
    """The text before each former name."""

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        return active.server.rename_items(self.prefix)


class Restart(Fault):
    """The server crashes and comes back on the same port with a new measurement."""

    kind: ClassVar[str] = "restart"

    away_s: Seconds = 1.0
    """Seconds until the server comes back."""

    scene: SceneSettings = SceneSettings()
    """The changes to the scenario's scene; by default, none."""

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.away_s

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        active.server.crash()
        if self.scene.model_fields_set:
            active.server.change_scene(self.scene)
        return active.server.restart


SERVER_FAULTS: Final[tuple[type[Fault], ...]] = (NoMeasurement, ChangeScene, Rename, Restart)
