"""A series as a table: columns of time, then one for each value. Exports and pandas have the same columns."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from gateway.errors import TakeError
from gateway.messages.descriptions.labels import distinct, event_text
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series_data import SeriesData

if TYPE_CHECKING:
    import pandas as pd
    import xarray

TIME_COLUMNS: Final = (
    "time_s",
    "capture_utime",
    "utime",
    "sequence",
    "session",
    "frame_number",
    "timestamp_us",
)
"""The columns before the values. ``time_s`` is in seconds since the beginning of the take."""

_TIME_UNITS: Final = {"time_s": "s", "capture_utime": "us", "utime": "us", "timestamp_us": "us"}
_EVENT_COLUMNS: Final = ("id", "label", "event_timestamp_us", "param1", "param2", "param3", "description")
_QUATERNION: Final = ("q0", "qx", "qy", "qz")
_MOMENTS: Final = ("mx", "my", "mz")


class Column(NamedTuple):
    """A column of values: what it is called, such as "head x", and its unit, "" without one."""

    name: str
    unit: str


def time_columns(series: SeriesData) -> dict[str, Array]:
    """Return the columns of TIME_COLUMNS, each of shape (rows,)."""
    return {"time_s": series.seconds, **{name: series.content.columns[name] for name in TIME_COLUMNS[1:]}}


def value_columns(series: SeriesData) -> tuple[Column, ...]:
    """Return the columns of the values, in their order; each name is different, also from TIME_COLUMNS."""
    if series.component is ComponentType.EVENT:
        return tuple(Column(name, "") for name in _EVENT_COLUMNS)
    fields = ITEM_DTYPES[series.component].names
    if fields is None:
        labels, units = list(series.labels), list(series.units)
    else:
        labels = [f"{label} {field}" for label in series.labels for field in fields]
        units = [_unit(series, unit, field) for unit in series.units for field in fields]
    return tuple(map(Column, distinct(labels, lambda label, _: label, TIME_COLUMNS), units))


def _unit(series: SeriesData, unit: str, field: str) -> str:
    if field in _QUATERNION:
        return ""
    return series.moment_unit if field in _MOMENTS else unit


def value_rows(series: SeriesData) -> Array:
    """Return the values as a table, float32, shape (rows, columns). Not of events."""
    values = series.values
    return values.reshape(len(series), int(np.prod(values.shape[1:])))


def event_columns(series: SeriesData) -> dict[str, list[Any]]:
    """Return the values of events by column, one for each row."""
    items = series.items
    texts = [event_text(series.parameters_of(row), item) for row, item in enumerate(items)]
    return {
        "id": items["id"].tolist(),
        "label": [text.label for text in texts],
        "event_timestamp_us": items["timestamp"].tolist(),
        **{name: items[name].tolist() for name in ("param1", "param2", "param3")},
        "description": [text.description for text in texts],
    }


def to_pandas(series: SeriesData) -> "pd.DataFrame":
    """Return a table: see ``Series.to_pandas``."""
    package = _installed("pandas")
    times = time_columns(series)
    index = package.Index(times.pop("time_s"), name="time_s")
    columns = value_columns(series)
    if series.component is ComponentType.EVENT:
        values = package.DataFrame(event_columns(series), index)
    else:
        values = package.DataFrame(value_rows(series), index, [column.name for column in columns])
    frame: pd.DataFrame = package.concat([package.DataFrame(times, index), values], axis=1)
    frame.attrs["units"] = units_by_column(columns)
    return frame


def units_by_column(columns: tuple[Column, ...]) -> dict[str, str]:
    """Return the units of the columns that have one, also of those of time."""
    return _TIME_UNITS | {column.name: column.unit for column in columns if column.unit}


def to_xarray(series: SeriesData) -> "xarray.Dataset":
    """Return a dataset: see ``Series.to_xarray``."""
    package = _installed("xarray")
    times = time_columns(series)
    seconds = times.pop("time_s")
    coordinates: dict[str, Any] = {"time": ("time", seconds, {"units": "s"})}
    coordinates |= {name: ("time", values) for name, values in times.items()}
    about = {"component": series.key, "start_utime": series.start_utime}
    if series.rate_hz:
        about["rate_hz"] = series.rate_hz
    if series.component is ComponentType.EVENT:
        variables: dict[str, Any] = {name: ("time", values) for name, values in event_columns(series).items()}
    else:
        item = series.component.item_noun.removesuffix("s")
        coordinates |= {item: list(series.labels), "unit": (item, list(series.units))}
        variables = {}
        for name, (first, parts) in _VARIABLES[series.component].items():
            values = series.values[..., None] if series.component is ComponentType.ANALOG else series.values
            dimensions = ["time", item]
            if parts:
                dimensions.append("part" if len(parts) == len(_QUATERNION) else "axis")
                coordinates[dimensions[-1]] = list(parts)
                values = values[..., first : first + len(parts)]
            else:
                values = values[..., first]
            unit = {"moment": series.moment_unit, "quaternion": ""}.get(name, series.unit)
            variables[name] = (dimensions, values, {"units": unit})
    dataset: xarray.Dataset = package.Dataset(variables, coordinates, about)
    return dataset


_AXES: Final = ("x", "y", "z")

_VARIABLES: Final[dict[ComponentType, dict[str, tuple[int, tuple[str, ...]]]]] = {
    ComponentType.MARKERS: {"position": (0, _AXES), "reliability": (3, ())},
    ComponentType.TOOLS: {"quaternion": (0, _QUATERNION), "position": (4, _AXES), "error": (7, ())},
    ComponentType.ANALOG: {"value": (0, ())},
    ComponentType.FORCE: {"force": (0, _AXES), "moment": (3, _AXES)},
}
"""The variables of a dataset: the first field of each, and what the fields along its last dimension are."""


def _installed(package: str) -> Any:
    """Return an optional package. Raises TakeError if it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise TakeError(
            f"{package} is not installed, and to_{package} needs it; install it: pip install {package}"
        ) from error
