"""Arrays of a take that are too large for memory: they are on the disk, and pages of them in memory.

The system counts the pages that were touched as memory of this process. ``release_pages`` gives them back;
what was written stays in the system's cache as long as there is room.
"""

import mmap
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt

_PIECE_ROWS: Final = 250_000

_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def spool_file(folder: Path) -> IO[bytes]:
    """Return a temporary file without a name, which is gone when it is closed. Raises OSError."""
    return tempfile.TemporaryFile(dir=folder)


def append(file: IO[bytes], rows: npt.NDArray[Any]) -> None:
    """Write rows to the end of a file. Raises OSError, which says that it is about a temporary file."""
    try:
        file.write(rows.tobytes())
    except OSError as error:
        raise OSError(error.errno, error.strerror, "a temporary file beside the new one") from error


def mapped(file: IO[bytes], dtype: np.dtype[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return what was written to a file as an array that cannot be changed; the file may be closed then."""
    file.flush()
    content = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
    _maps.add(content)
    return np.frombuffer(content, dtype).reshape(shape)


def release_pages() -> None:
    """Give back the memory that pages of arrays on the disk take. Their content stays."""
    for content in tuple(_maps):
        content.madvise(mmap.MADV_DONTNEED)


def pieces(num_rows: int) -> Iterator[tuple[int, int]]:
    """Yield the beginnings and ends of pieces of arrays, so that work on long ones takes little memory."""
    for start in range(0, num_rows, _PIECE_ROWS):
        yield start, min(start + _PIECE_ROWS, num_rows)
        release_pages()
