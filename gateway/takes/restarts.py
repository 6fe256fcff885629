"""Where the numbers and time stamps of a component start again within a take."""

from typing import Final, NamedTuple

import numpy as np

from gateway.takes.component_rows import Array

MAX_LATE: Final = 1000
"""If a sequence number goes back by more, it starts again; by less, another message may have overtaken it."""

_NO_TIMES_US: Final = np.array([0, -1, -(1 << 63)], np.int64)
"""What servers send if they have no time (field note 25)."""

_MAX_STEP: Final = 10
_MAX_STEP_US: Final = 1_000_000
"""Two messages with at most one between them fit each other if they are not further apart than this."""

_WRAP: Final = 1 << 32
_WRAP_TOLERANCE_US: Final = 10_000_000
"""32-bit time stamps start again at 0; a time stamp that goes back by about this much has wrapped around."""


class Restarts(NamedTuple):
    """For each row but the first, whether something starts again there; bool, shape (rows − 1,).

    ``sequence``: the gateway started again, or the rows belong to another take. ``server``: the server's time
    stamps or frame numbers start again, with a new measurement or a new start of the server.
    """

    sequence: Array
    server: Array


def find_restarts(utime: Array, sequence: Array, timestamp_us: Array, frame_number: Array) -> Restarts:
    """Return where rows, in the order of arrival, start again. The arrays are native integers.

    A message that was overtaken by others on the network is no restart, and neither is one message with
    damaged numbers.
    """
    step = np.diff(sequence)
    is_restart = (step < -MAX_LATE) | ((step <= 0) & (np.diff(utime) > 0))
    is_late = (step <= 0) & ~is_restart
    is_server = _time_goes_back(timestamp_us)
    frame_step = np.diff(frame_number.astype(np.int64))
    is_server |= (frame_step < 0) & (frame_step > -(_WRAP // 2))
    is_intact = ~_is_beside_damage(sequence, timestamp_us, frame_number)
    return Restarts(is_restart & is_intact, is_server & ~is_late & is_intact)


def _is_beside_damage(sequence: Array, timestamp_us: Array, frame_number: Array) -> Array:
    """Return for each step whether the row before it, or after it, lies between two that fit each other."""
    beside = np.zeros(max(len(sequence) - 1, 0), bool)
    step, time_step = sequence[2:] - sequence[:-2], timestamp_us[2:] - timestamp_us[:-2]
    regular_steps = np.diff(timestamp_us)
    regular_steps = regular_steps[(regular_steps > 0) & (regular_steps <= _MAX_STEP_US)]
    if not len(regular_steps):
        return beside
    fits = (frame_number[2:] >= frame_number[:-2]) & (step > 0) & (step <= _MAX_STEP)
    fits &= (time_step >= 1.5 * np.median(regular_steps)) & (time_step <= _MAX_STEP_US)
    beside[:-1] |= fits
    beside[1:] |= fits
    return beside


def _time_goes_back(timestamp_us: Array) -> Array:
    """Return where time stamps are less than the newest one before; those without a time do not count."""
    goes_back = np.zeros(max(len(timestamp_us) - 1, 0), bool)
    (places,) = np.nonzero(~np.isin(timestamp_us, _NO_TIMES_US))
    step = np.diff(timestamp_us[places])
    is_wrap = np.abs(step + _WRAP) < _WRAP_TOLERANCE_US
    # If rows without a time are between both, the first of them belongs to what follows: it may begin at 0.
    goes_back[places[:-1][(step < 0) & ~is_wrap]] = True
    return goes_back
