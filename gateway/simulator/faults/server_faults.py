"""Faults of the server as a whole: no measurement, another scene, a restart."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Final

from gateway.simulator.faults.base import Fault, LastingFault, Run, Seconds
from gateway.simulator.scene_settings import SceneSettings


class NoMeasurement(LastingFault):
    """The measurement stops; at the end another one starts."""

    kind: ClassVar[str] = "no_measurement"

    def begin(self, run: Run) -> Callable[[], None]:
        """See Fault."""
        run.simulator.stop_measurement()
        return run.simulator.faults.start_measurement


class ChangeScene(LastingFault):
    """Other markers, tools and so on come in mid-measurement; at the end the former ones are back."""

    kind: ClassVar[str] = "change_scene"

    scene: SceneSettings = SceneSettings(markers=12)
    """What changes of the scenario's scene; by default, 12 markers."""

    def begin(self, run: Run) -> Callable[[], None]:
        """See Fault."""
        simulator, before = run.simulator, run.simulator.scene
        simulator.change_scene(simulator.faults.scene.changed_by(self.scene).build())
        return lambda: simulator.change_scene(before)


class Restart(Fault):
    """The server dies, and comes back on the same port with a new measurement."""

    kind: ClassVar[str] = "restart"

    away_s: Seconds = 1.0
    """How long it is away."""

    scene: SceneSettings = SceneSettings()
    """What changes of the scenario's scene; by default, nothing."""

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.away_s

    def begin(self, run: Run) -> Callable[[], None]:
        """See Fault."""
        simulator = run.simulator
        simulator.vanish()
        if self.scene.model_fields_set:
            simulator.scene = simulator.faults.scene.changed_by(self.scene).build()
        return simulator.faults.come_back


SERVER_FAULTS: Final[tuple[type[Fault], ...]] = (NoMeasurement, ChangeScene, Restart)
