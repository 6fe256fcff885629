"""The simulator: an RT server that can have faults, with a scene and faults from a scenario file in YAML."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import PlainValidator, SerializeAsAny

from gateway.config.loading import load_as
from gateway.config.section import Section, expects
from gateway.rtc3d_server.scene import Scene
from gateway.rtc3d_server.server import RtServer
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.control import Faults, validate_fault
from gateway.simulator.synthetic import SceneSettings, Seed


class Simulator(RtServer):
    """An RT server that replaces the hardware in tests, and has faults on request.

    RtServer describes the arguments.
    """

    def __init__(
        self,
        scene: Scene,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        event_bytes: int = 24,
        once: bool = False,
    ) -> None:
        self.faults = Faults(self)
        """Begins and ends faults; by default there are none."""
        super().__init__(
            scene,
            host,
            port,
            event_bytes=event_bytes,
            once=once,
            name="RTC3D simulator",
            new_filter=self.faults.new_pipeline,
        )

    async def close(self) -> None:
        """End the faults, stop the measurement, close the connections, and stop listening."""
        await self.faults.close()
        await super().close()


_EXAMPLE: Final = "config/scenarios/bad-day.yaml"


class Scenario(Section):
    """The content of a scenario file."""

    scene: SceneSettings = SceneSettings()
    """The synthetic scene at the start."""

    faults: Annotated[
        tuple[Annotated[SerializeAsAny[Fault], PlainValidator(validate_fault)], ...],
        expects("a list of faults"),
    ]
    """The faults; ``rtc3d-gateway simulate --list-faults`` describes their kinds."""

    seed: Seed = 1
    """The seed of all random choices of the faults."""

    def with_overrides(self, scene: Mapping[str, float], faults: Iterable[Fault], seed: int | None) -> Self:
        """Return this scenario with changes to its scene, more faults, and ``seed`` unless it is None."""
        return self.model_copy(
            update={
                "scene": self.scene.model_copy(update=dict(scene)),
                "faults": (*self.faults, *faults),
                "seed": self.seed if seed is None else seed,
            }
        )


def load_scenario(path: Path) -> Scenario:
    """Return the scenario in the YAML file at ``path``.

    Raises ConfigError with one line per mistake: file, line, column, key, and what was expected.
    """
    return load_as(Scenario, path, example=_EXAMPLE)
