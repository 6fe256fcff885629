"""Several series of one component as one, such as those of a source that was recorded twice."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gateway.takes.files.component_rows import Array
from gateway.takes.files.parameters_history import ParametersEntry
from gateway.takes.files.series import Series
from gateway.takes.files.series_data import SeriesContent


def join_series(parts: Sequence[Series]) -> Series:
    """Return the rows of series of one component as one, in the order of their arrival at the gateway.

    A message that several of them have, with the same ``utime``, ``session`` and ``sequence``, occurs once.
    """
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda part: int(part.utime.min()))
    contents = [part.content for part in parts]
    columns = {
        name: np.concatenate([content.columns[name] for content in contents]) for name in contents[0].columns
    }
    entries: list[Array] = []
    parameters: list[ParametersEntry] = []
    for number, content in enumerate(contents):
        if number and content.parameters is contents[number - 1].parameters:  # of takes in one file
            first = len(parameters) - len(content.parameters)
        else:
            first = len(parameters)
            parameters += content.parameters
        entries.append(np.where(content.entries >= 0, content.entries.astype(np.int64) + first, -1))
    if all(before.utime.max() < after.utime.min() for before, after in pairwise(parts)):
        order = np.arange(len(columns["utime"]))
    else:
        order = _order_without_duplicates(columns, np.repeat(np.arange(len(parts)), [*map(len, parts)]))
    num_items = columns["num_items"]
    recorded = {}
    for number in dict.fromkeys(number for content in contents for number in content.recorded):
        items = np.concatenate([each.recorded[number] for each in contents if number in each.recorded])
        places = np.cumsum(num_items == number) - 1
        recorded[number] = items[places[order[num_items[order] == number]]]
    content = SeriesContent(
        {name: column[order] for name, column in columns.items()},
        recorded,
        parameters,
        np.concatenate(entries)[order],
    )
    return Series(parts[0].component, content, parts[0].start_utime)


def _order_without_duplicates(columns: dict[str, Array], part: Array) -> Array:
    """Return the indices of rows by time of arrival, without messages that an earlier part has, too.

    ``part`` is the number of the part of each row. A message with several events has several equal rows in
    one part, which all stay.
    """
    keys = [columns[name] for name in ("sequence", "session", "utime")]  # the last one is the most important
    order = np.lexsort([part, *keys])
    is_new = np.ones(len(order), bool)
    is_new[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    first_part = part[order][is_new][np.cumsum(is_new) - 1]
    kept: Array = order[part[order] == first_part]
    return kept
