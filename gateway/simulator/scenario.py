"""A scenario: the scene that the simulator plays and its faults, in a YAML file."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import PlainValidator, SerializeAsAny

from gateway.config.loading import load_as
from gateway.config.section import Section, expects
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.kinds import fault_of
from gateway.simulator.scene_settings import SceneSettings, Seed

_EXAMPLE: Final = "config/scenarios/bad-day.yaml"


class Scenario(Section):
    """What a scenario file holds."""

    scene: SceneSettings = SceneSettings()
    """The synthetic scene at the start."""

    faults: Annotated[
        tuple[Annotated[SerializeAsAny[Fault], PlainValidator(fault_of)], ...], expects("a list of faults")
    ]
    """What goes wrong; see ``gateway.simulator.faults``."""

    seed: Seed = 1
    """Chooses another course of everything that is random in the faults."""

    def extended(self, scene: Mapping[str, float], faults: Iterable[Fault], seed: int | None) -> Self:
        """Return this scenario with other values in its scene, more faults, and the seed if one is given."""
        return self.model_copy(
            update={
                "scene": self.scene.model_copy(update=dict(scene)),
                "faults": (*self.faults, *faults),
                "seed": self.seed if seed is None else seed,
            }
        )


def load_scenario(path: Path) -> Scenario:
    """Return the scenario in the YAML file at ``path``.

    Raises ConfigError with one line per mistake: file, line, column, key, what is accepted.
    """
    return load_as(Scenario, path, example=_EXAMPLE)
