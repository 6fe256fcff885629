"""Series as tables of pandas and datasets of xarray."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gateway.errors import TakeError
from gateway.takes import open_take
from gateway.takes.export.job import ExportJob, export_take
from gateway.takes.files.take import TakeSource
from tests.support.documents import ROOT
from tests.support.errors import raises
from tests.support.takes import markers, write_take
from tests.unit.takes.export.exported import labelled

WALK = ROOT / "examples/walk.lcmlog"


@pytest.fixture(scope="module")
def walk() -> TakeSource:
    return open_take(WALK).sources["lab"]


def test_a_table_of_pandas_is_that_of_the_export(walk: TakeSource, tmp_path: Path) -> None:
    """So an analysis works on both; that the export is right is proved in test_parquet.py."""
    export_take(ExportJob(WALK, tmp_path / "walk.parquet"))
    for key, series in walk.series.items():
        exported = pd.read_parquet(tmp_path / f"walk-{key}.parquet").set_index("time_s")
        found = series.to_pandas()
        pd.testing.assert_frame_equal(found, exported, check_names=True)
        assert found.attrs["units"] == exported.attrs["units"]


def test_a_dataset_of_xarray_has_values_labels_and_units(walk: TakeSource) -> None:
    assert walk.markers
    assert walk.tools
    assert walk.analog
    assert walk.forces
    markers = walk.markers.to_xarray()
    assert dict(markers.sizes) == {"time": 250, "marker": 34, "axis": 3}
    y = markers["position"].sel(marker="LASI", axis="y")
    assert np.array_equal(y, walk.markers["LASI"][:, 1], equal_nan=True)
    assert np.array_equal(markers["time"], walk.markers.seconds)
    assert np.array_equal(markers["reliability"], walk.markers.items["reliability"], equal_nan=True)
    assert (markers["position"].attrs, markers["time"].attrs) == ({"units": "mm"}, {"units": "s"})
    assert markers.attrs == {"component": "3d", "start_utime": walk.markers.start_utime, "rate_hz": 50.0}
    tools = walk.tools.to_xarray()
    assert np.array_equal(tools["position"], walk.tools.positions, equal_nan=True)
    assert np.array_equal(tools["quaternion"].sel(part="qy"), walk.tools.items["qy"], equal_nan=True)
    assert np.array_equal(tools["error"], walk.tools.items["error"], equal_nan=True)
    assert (tools["quaternion"].attrs, tools["error"].attrs) == ({"units": ""}, {"units": "mm"})
    analog = walk.analog.to_xarray()
    assert np.array_equal(analog["value"], walk.analog.values)
    assert analog["unit"].sel(channel="EMG left calf") == "mV"
    forces = walk.forces.to_xarray()
    assert np.array_equal(forces["force"].sel(axis="z"), walk.forces.items["fz"])
    assert np.array_equal(forces["moment"].sel(axis="x"), walk.forces.items["mx"])
    assert (forces["force"].attrs, forces["moment"].attrs) == ({"units": "N"}, {"units": "Nm"})


def test_a_dataset_of_events_has_their_texts(walk: TakeSource) -> None:
    assert walk.events
    events = walk.events.to_xarray()
    assert set(events["label"].to_numpy()) == {"Foot strike"}
    assert events["description"].to_numpy()[0].startswith("Foot: RIGHT; Number of the force plate")
    assert np.array_equal(events["id"], walk.events.items["id"])


def test_without_the_package_the_error_says_what_to_install(
    walk: TakeSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert walk.markers
    for package in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    with raises(TakeError, "pip install pandas"):
        walk.markers.to_pandas()
    with raises(TakeError, "pip install xarray"):
        walk.markers.to_xarray()


def test_a_label_that_does_not_exist_has_a_hint_at_its_spelling(tmp_path: Path) -> None:
    """The error of a take with hundreds of labels stays short."""
    names = [f"M{number}" for number in range(200)]
    messages = [labelled("LASI", *names), markers(201)]
    found = open_take(write_take(tmp_path / "a.lcmlog", messages)).sources["lab"].markers
    assert found is not None
    with pytest.raises(KeyError) as caught:
        found["lasj"]
    assert "'LASI'" in str(caught.value)
    assert len(str(caught.value)) < 300
