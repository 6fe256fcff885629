"""Export to Parquet: pandas and pyarrow read exactly what was recorded, with units and what is known."""

import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import AnalogChannel, Parameters, ParametersAnalog
from gateway.simulator.c3d_scene import C3dScene
from gateway.takes import open_take
from gateway.takes.export import parquet
from gateway.takes.export.job import ExportJob, export_take
from gateway.takes.files import event_log, reader
from gateway.takes.files.tables import TIME_COLUMNS
from tests.support.documents import ROOT
from tests.support.errors import names, raises
from tests.support.takes import START_UTIME, description, details, frame, parameters, record_scene
from tests.unit.takes.export.exported import export_messages, notes_of, scene

WALK = ROOT / "examples/walk.lcmlog"


@pytest.mark.parametrize(
    "name",
    [
        "walk.lcmlog",
        *(pytest.param(each, marks=pytest.mark.takes) for each in ("qualisys.c3d", "optotrak.c3d")),
    ],
)
def test_pandas_reads_every_number_of_every_component_as_it_was_recorded(name: str, tmp_path: Path) -> None:
    """The bits of each value, of NaN also: nothing is rounded on the way."""
    take = WALK
    if name.endswith(".c3d"):
        recording = C3dScene(Path(os.environ["RTC3D_TAKES"]) / name)
        take = record_scene(tmp_path / "take.lcmlog", recording, 100)
    job = ExportJob(take, tmp_path / "walk.parquet")
    export_take(job)
    assert notes_of(job) == []
    [source] = open_take(take).sources.values()
    assert sorted(job.files.paths) == sorted(tmp_path / f"walk-{key}.parquet" for key in source.series)
    for key, series in source.series.items():
        found = pd.read_parquet(tmp_path / f"walk-{key}.parquet")
        assert tuple(found.columns[:7]) == TIME_COLUMNS
        assert np.array_equal(found["time_s"], series.seconds)
        for column in TIME_COLUMNS[1:]:
            assert found[column].dtype == getattr(series, column).dtype
            assert np.array_equal(found[column], getattr(series, column))
        if key == "event":
            assert found["id"].tolist() == series.items["id"].tolist()
            assert found["event_timestamp_us"].tolist() == series.items["timestamp"].tolist()
            assert found["param3"].tolist() == series.items["param3"].tolist()
            continue
        values = found.iloc[:, 7:]
        assert set(values.dtypes) == {np.dtype(np.float32)}
        bits = values.to_numpy().view(np.uint32)
        assert np.array_equal(bits, series.items.view(np.uint32).reshape(len(series), -1))


def test_columns_have_labels_and_units_and_the_file_says_what_is_known(tmp_path: Path) -> None:
    described = Parameters(analog=ParametersAnalog((AnalogChannel("1", "EMG", unit="V"),)))
    messages = [
        description(server="192.0.2.7:3020"),
        details("Ada", "day 1", "barefoot"),
        parameters(described),
        frame(ComponentType.MARKERS, [(1, 2, 3, 4)]),
        frame(ComponentType.ANALOG, [0.1]),
    ]
    export_messages(tmp_path, messages, "walk.parquet")
    schema = pq.read_schema(tmp_path / "walk-3d.parquet")
    assert schema.names[7:] == [f"marker 1 {field}" for field in ("x", "y", "z", "reliability")]
    assert {schema.field(name).metadata[b"unit"] for name in schema.names[7:]} == {b"mm"}
    assert schema.field("time_s").metadata == {b"unit": b"s"}
    assert schema.field("sequence").metadata is None
    found = pd.read_parquet(tmp_path / "walk-analog.parquet")
    units = found.attrs.pop("units")
    assert (units["EMG"], units["time_s"], "sequence" in units) == ("V", "s", False)
    about = {
        "source": "lab",
        "component": "analog",
        "server": "192.0.2.7:3020",
        "gateway_version": "1.0",
        "subject": "Ada",
        "session": "day 1",
        "note": "barefoot",
        "start_utime": str(START_UTIME),
        "start_time": "2023-11-14T22:13:20.000000Z",
    }
    assert found.attrs == about
    metadata = pq.read_schema(tmp_path / "walk-analog.parquet").metadata
    assert {name: metadata[name.encode()].decode() for name in about} == about


def test_a_label_that_is_called_like_a_column_of_time_gets_a_number(tmp_path: Path) -> None:
    channels = tuple(AnalogChannel(str(number), label) for number, label in enumerate(("utime", "time_s")))
    messages = [
        parameters(Parameters(analog=ParametersAnalog(channels))),
        frame(ComponentType.ANALOG, [0.5, 0.25]),
    ]
    job = export_messages(tmp_path, messages, "walk.parquet")
    for name in ("time_s", "utime"):
        assert names(str(job.notes), f"{name}_2")
    found = pd.read_parquet(tmp_path / "walk-analog.parquet")
    assert (found["utime_2"].tolist(), found["time_s_2"].tolist()) == ([0.5], [0.25])


def test_rows_are_written_in_groups_before_much_of_them_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, the memory would grow with the take."""
    messages = scene(100)
    export_messages(tmp_path, messages, "whole.parquet")
    monkeypatch.setattr(reader, "_BATCH_BYTES", 2000)
    monkeypatch.setattr(event_log, "_READ_BYTES", 1000)
    monkeypatch.setattr(parquet, "_MAX_WAITING_BYTES", 10_000)
    export_messages(tmp_path, messages, "parts.parquet")
    for key in ("3d", "analog", "force"):
        parts, whole = (pq.ParquetFile(tmp_path / f"{name}-{key}.parquet") for name in ("parts", "whole"))
        groups = [parts.metadata.row_group(number) for number in range(parts.num_row_groups)]
        assert len(groups) > 2
        assert max(group.total_byte_size for group in groups) < 12_000
        assert whole.num_row_groups == 1
        pd.testing.assert_frame_equal(parts.read().to_pandas(), whole.read().to_pandas())


def test_without_pyarrow_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "gateway.takes.export.parquet")
    with raises(TakeError, "pyarrow", "'rtc3d-gateway[parquet]'"):
        export_take(ExportJob(WALK, tmp_path / "walk.parquet"))
    assert not list(tmp_path.iterdir())
