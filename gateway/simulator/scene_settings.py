"""The settings of a synthetic scene: sizes, rates, labels and seed."""

from dataclasses import replace
from typing import Annotated, Self

from pydantic import Field

from gateway.config.section import Section, expects
from gateway.simulator.synthetic import SyntheticScene

Size = Annotated[int, Field(strict=True, ge=0, le=10_000), expects("a whole number from 0 to 10000")]
Rate = Annotated[
    float,
    Field(strict=True, ge=0.1, le=100_000, allow_inf_nan=False),
    expects("a number of samples per second from 0.1 to 100000"),
]
Label = Annotated[str, Field(min_length=1, max_length=60), expects("a text of 1 to 60 characters")]
Seed = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1), expects("a whole number, 0 or more")]


class SceneSettings(Section):
    """The arguments of SyntheticScene, and the labels of its markers."""

    markers: Size = 24
    """The number of markers."""

    tools: Size = 4
    """The number of 6D tools."""

    analog: Size = 16
    """The number of analog channels."""

    plates: Size = 2
    """The number of force plates."""

    rate_hz: Rate = 200.0
    """Samples per second of markers and tools."""

    analog_rate_hz: Rate = 2000.0
    """Samples per second of analog channels and force plates."""

    marker_label: Label = "Marker"
    """The text before the number in the markers' labels."""

    seed: Seed = 1
    """Another seed gives another scene of the same size."""

    def with_changes(self, changes: Self) -> Self:
        """Return these settings with the values that ``changes`` sets."""
        return self.model_copy(update={name: getattr(changes, name) for name in changes.model_fields_set})

    def build(self) -> SyntheticScene:
        """Return the scene."""
        scene = SyntheticScene(**self.model_dump(exclude={"marker_label"}))
        parameters_3d = scene.parameters.markers
        if parameters_3d is not None:
            markers = tuple(
                replace(marker, label=f"{self.marker_label} {marker.id}") for marker in parameters_3d.markers
            )
            scene.parameters = replace(scene.parameters, markers=replace(parameters_3d, markers=markers))
        return scene
