"""Scenario files: the simulator's scene and faults, in YAML."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import PlainValidator, SerializeAsAny

from gateway.config.loading import load_as
from gateway.config.section import Section, expects
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.kinds import validate_fault
from gateway.simulator.scene_settings import SceneSettings, Seed

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
