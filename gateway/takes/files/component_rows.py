"""Decoding many messages of one component at once with numpy, and finding where their numbers start again."""

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gateway.messages.encode import ITEMS_OFFSET
from gateway.messages.sequence_check import MAX_LATE
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.takes.files.spool import append, mapped, spool_file

HEAD: Final = np.dtype(
    [
        ("fingerprint", ">u8"),
        ("utime", ">i8"),
        ("capture_utime", ">i8"),
        ("sequence", ">i8"),
        ("session", ">i4"),
        ("parameters_version", ">i4"),
        ("frame_number", ">i4"),
        ("timestamp_us", ">i8"),
        ("num_items", ">i4"),
    ]
)
"""Everything in a component's message before its items (docs/reference/messages.md)."""
assert HEAD.itemsize == ITEMS_OFFSET  # noqa: S101 - both describe the same bytes

NATIVE_ITEM_DTYPES: Final[dict[ComponentType, np.dtype[Any]]] = {
    component: dtype.newbyteorder("=") for component, dtype in ITEM_DTYPES.items()
}
"""ITEM_DTYPES in the byte order of this computer."""

_unpack_head: Final = struct.Struct(">Qqqqiiiqi").unpack_from
"""Reads the fields of HEAD."""

_WORD: Final = np.dtype(">u4")

Array: TypeAlias = npt.NDArray[Any]


class Rows(NamedTuple):
    """The content of messages of one component, in their order.

    ``heads`` has the dtype HEAD, shape (messages,). ``items`` has an entry for each number of items: the
    items of the messages with this number, shape (messages, items), as in NATIVE_ITEM_DTYPES. ``malformed``
    is how many messages were left out, because their size contradicts their number of items.
    """

    heads: Array
    items: dict[int, Array]
    malformed: int


def decode_rows(component: ComponentType, messages: Sequence[bytes]) -> Rows:
    """Return the content of messages of one component. Their fingerprints are not checked."""
    sizes = np.fromiter(map(len, messages), np.int64, len(messages))
    item_bytes = ITEM_DTYPES[component].itemsize
    if len(messages) and sizes[0] >= ITEMS_OFFSET and (sizes == sizes[0]).all():
        table = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), sizes[0])
        heads = np.ascontiguousarray(table[:, :ITEMS_OFFSET]).view(HEAD)[:, 0]
        num_items = int(heads["num_items"][0])
        if sizes[0] == ITEMS_OFFSET + num_items * item_bytes and (heads["num_items"] == num_items).all():
            return Rows(heads, {num_items: _items(component, table[:, ITEMS_OFFSET:], num_items)}, 0)
    return _decode_different(component, messages, sizes)


def decode_row(component: ComponentType, message: bytes) -> tuple[tuple[int, ...], Array] | None:
    """Return the fields of HEAD and the items, shape (1, items), of one message; None if it is malformed.

    Of one message, this is several times faster than ``decode_rows``.
    """
    if len(message) < ITEMS_OFFSET:
        return None
    head = _unpack_head(message)
    num_items = head[-1]
    dtype, native = ITEM_DTYPES[component], NATIVE_ITEM_DTYPES[component]
    if len(message) != ITEMS_OFFSET + num_items * dtype.itemsize:
        return None
    if component is ComponentType.EVENT:
        items: Array = np.frombuffer(message, dtype, num_items, ITEMS_OFFSET).astype(native)
    else:
        items = np.frombuffer(message, _WORD, -1, ITEMS_OFFSET).astype(np.uint32).view(native)
    return head, items.reshape(1, num_items)


def _decode_different(component: ComponentType, messages: Sequence[bytes], sizes: Array) -> Rows:
    """Return the content of messages of different sizes, some of which may be malformed."""
    heads = np.frombuffer(
        b"".join([message[:ITEMS_OFFSET].ljust(ITEMS_OFFSET, b"\0") for message in messages]), HEAD
    )
    counts = heads["num_items"].astype(np.int64)
    is_whole = sizes == ITEMS_OFFSET + ITEM_DTYPES[component].itemsize * counts
    items: dict[int, Array] = {}
    for num_items in np.unique(counts[is_whole]).tolist():
        (indices,) = np.nonzero(is_whole & (counts == num_items))
        data = b"".join([messages[index][ITEMS_OFFSET:] for index in indices.tolist()])
        table = np.frombuffer(data, np.uint8).reshape(len(indices), -1 if data else 0)
        items[num_items] = _items(component, table, num_items)
    return Rows(heads[is_whole], items, len(messages) - int(is_whole.sum()))


def _items(component: ComponentType, table: Array, num_items: int) -> Array:
    """Return items of shape (messages, num_items) from their bytes, shape (messages, bytes)."""
    dtype = ITEM_DTYPES[component]
    if component is ComponentType.EVENT:
        items = np.ascontiguousarray(table).view(dtype).astype(NATIVE_ITEM_DTYPES[component])
    else:
        # Swapping words is much faster than converting field by field, and keeps the bits of each NaN.
        words = np.ascontiguousarray(table).view(">u4").astype(np.uint32)
        items = words.view(NATIVE_ITEM_DTYPES[component])
    return items.reshape(len(table), num_items)


_GROWTH: Final = 1.125
"""How much more room each enlargement makes: what is not filled takes memory, too."""

_IN_MEMORY_BYTES: Final = 4 * 1024 * 1024
"""Larger arrays go to the disk, if there is a folder for them."""


class GrowingArray:
    """Rows of a fixed shape. The system enlarges large arrays by moving their pages, not their content.

    With a ``spool_folder``, a large one is in a temporary file there, and takes no memory.
    """

    def __init__(
        self, dtype: np.dtype[Any], row_shape: tuple[int, ...] = (), spool_folder: Path | None = None
    ) -> None:
        self._rows: Array = np.empty((0, *row_shape), dtype)
        self._num_rows = 0
        self._spool_folder = spool_folder
        self._file: IO[bytes] | None = None

    def extend(self, rows: Array) -> None:
        """Append rows; they are converted to the dtype. Raises OSError if there is no room on the disk."""
        stop = self._num_rows + len(rows)
        num_bytes = stop * self._rows.dtype.itemsize * math.prod(self._rows.shape[1:])
        if self._file is None and self._spool_folder is not None and num_bytes > _IN_MEMORY_BYTES:
            self._file = spool_file(self._spool_folder)
            append(self._file, self._rows[: self._num_rows])
            self._resize(0)
        if self._file is not None:
            append(self._file, rows.astype(self._rows.dtype, copy=False))
        else:
            if stop > len(self._rows):
                self._resize(max(stop, int(len(self._rows) * _GROWTH)))
            self._rows[self._num_rows : stop] = rows
        self._num_rows = stop

    def take(self) -> Array:
        """Return the rows, and forget them. Those on the disk cannot be changed."""
        if self._file is not None:
            with self._file as file:
                rows = mapped(file, self._rows.dtype, (self._num_rows, *self._rows.shape[1:]))
            self._file = None
        else:
            self._resize(self._num_rows)
            rows, self._rows = self._rows, self._rows[:0].copy()
        self._num_rows = 0
        return rows

    def _resize(self, num_rows: int) -> None:
        # Nothing else refers to the array, and it is not used while it is resized.
        self._rows.resize((num_rows, *self._rows.shape[1:]), refcheck=False)


NO_TIMES_US: Final = np.array([0, -1, -(1 << 63)], np.int64)
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
    (places,) = np.nonzero(~np.isin(timestamp_us, NO_TIMES_US))
    step = np.diff(timestamp_us[places])
    is_wrap = np.abs(step + _WRAP) < _WRAP_TOLERANCE_US
    # If rows without a time are between both, the first of them belongs to what follows: it may begin at 0.
    goes_back[places[:-1][(step < 0) & ~is_wrap]] = True
    return goes_back
