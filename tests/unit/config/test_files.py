import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.config.files import read_file


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


def _huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (os.mkfifo, r"it is a pipe \(FIFO\), not a file"),
        (Path.mkdir, "it is a folder, not a file"),
        (_socket, "it is a socket, not a file"),
        (lambda path: path.symlink_to("/dev/zero"), "it is a device, not a file"),
        (lambda path: path.symlink_to("/dev/null"), "it is a device, not a file"),
        (lambda path: path.symlink_to("missing"), "No such file or directory"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda path: path.touch(), None),
        (_huge, "it is too large; the limit is 262144 bytes"),
    ],
)
def test_what_is_no_small_file_is_refused_at_once(
    tmp_path: Path, make: Callable[[Path], None], problem: str | None
) -> None:
    path = tmp_path / "lab.yaml"
    make(path)
    if problem is None:
        assert read_file(path) == b""
    else:
        with pytest.raises(OSError, match=problem):
            read_file(path)
