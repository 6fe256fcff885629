"""Reads an export with OpenSim itself: markers, channels, and the forces on the bodies of a model.

    make opensim

OpenSim takes 280 MB, so this is not part of the tests. tests/unit/takes/export/test_opensim.py reads the same
files with parsers that follow OpenSim's.
"""

import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import opensim

from gateway.takes import open_take
from gateway.takes.export.job import ExportJob, OpenSimOptions, export_take
from tests.support.documents import ROOT

TAKE: Final = ROOT / "examples/walk.lcmlog"
BODIES: Final = ("calcn_r", "calcn_l")
WEIGHT_N: Final = 700.0


def vector(found: Any) -> list[float]:
    return [found.get(axis) for axis in range(3)]


def values_of(table: Any) -> Any:
    """Return the values of a table; they are copied, because OpenSim's end with the table."""
    return table.getMatrix().to_numpy().copy()


def model_with(loads: Path) -> tuple[Any, Any]:
    """Return a model with two feet and these external loads, and the loads."""
    model = opensim.Model()
    for name in BODIES:
        body = opensim.Body(name, 1.0, opensim.Vec3(0), opensim.Inertia(1, 1, 1))
        model.addBody(body)
        model.addJoint(opensim.FreeJoint(f"{name}_joint", model.getGround(), body))
    external = opensim.ExternalLoads(str(loads), True)
    model.addModelComponent(external)
    model.finalizeConnections()
    model.initSystem()
    return model, external


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "out"
        export_take(ExportJob(TAKE, folder, "opensim", opensim=OpenSimOptions("z", "x", 10.0, BODIES)))
        source = open_take(TAKE).sources["lab"]
        assert source.markers is not None
        assert source.analog is not None

        markers = opensim.TimeSeriesTableVec3(str(folder / "walk.trc"))
        x, y, z = np.moveaxis(source.markers.positions, 2, 0)
        expected = np.stack([x, z, -y], axis=2).reshape(len(x), -1) / 1000
        flat = markers.flatten()
        found = values_of(flat)
        assert list(markers.getColumnLabels()) == list(source.markers.labels)
        assert markers.getTableMetaDataAsString("Units") == "m"
        assert np.allclose(found, expected, atol=1e-7, equal_nan=True)

        channels = opensim.TimeSeriesTable(str(folder / "walk.sto"))
        assert np.array_equal(values_of(channels).astype(np.float32), source.analog.items)

        reactions = opensim.TimeSeriesTable(str(folder / "walk.mot"))
        labels = list(reactions.getColumnLabels())
        rows = values_of(reactions)
        times_s = reactions.getIndependentColumn()
        model, external = model_with(folder / "walk.xml")
        assert [external.get(index).get_applied_to_body() for index in range(2)] == list(BODIES)
        for index in range(external.getSize()):
            force = external.get(index)
            names = (
                force.get_force_identifier(),
                force.get_point_identifier(),
                force.get_torque_identifier(),
            )
            columns = [[labels.index(f"{each}{axis}") for axis in "xyz"] for each in names]
            strongest = int(rows[:, columns[0][1]].argmax())
            assert rows[strongest, columns[0][1]] > WEIGHT_N
            time_s = times_s[strongest]
            computed = [
                force.getForceAtTime(time_s),
                force.getPointAtTime(time_s),
                force.getTorqueAtTime(time_s),
            ]
            for values, each in zip(computed, columns, strict=True):
                assert np.allclose(vector(values), rows[strongest, each], atol=1e-6)
            print(f"{force.getName()} at {time_s:.3f} s: {vector(computed[0])} N")
        del model
    print(f"OpenSim {opensim.GetVersion()} reads {len(found)} frames and {len(rows)} ground reactions")


if __name__ == "__main__":
    main()
