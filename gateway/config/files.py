"""Where files are, and reading those whose paths come from a person: each may be a pipe or a device."""

import errno
import os
import stat
from pathlib import Path
from typing import Final

DEFAULT_CONFIG: Final = Path("/etc/rtc3d-gateway/gateway.yaml")
"""The configuration file of commands that are given none; ``make install`` writes it."""

SERVICE_STATE: Final = Path("/var/lib/rtc3d-gateway")
"""The state directory of the service, outside of it; systemd/rtc3d-gateway.service names it."""

MAX_FILE_BYTES: Final = 256 * 1024
"""The size limit of a configuration file; reading and checking so much text takes less than 1 s."""

_KINDS: Final = {
    stat.S_IFIFO: "a pipe (FIFO)",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def read_file(path: Path, limit_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file of at most ``limit_bytes``.

    Raises OSError, whose ``strerror`` says what is wrong. Does not wait for the other end of a pipe.
    """
    check_is_file(path)
    # With O_NONBLOCK, this does not wait for a writer if a pipe has replaced the file since the check.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        data = file.read(limit_bytes + 1)
    if len(data) > limit_bytes:
        raise OSError(errno.EFBIG, f"it is too large; the limit is {limit_bytes} bytes")
    return data


def check_is_file(path: Path) -> None:
    """Raise OSError if ``path`` is not a regular file; ``strerror`` says what it is instead."""
    kind = stat.S_IFMT(path.stat().st_mode)
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {_KINDS.get(kind, 'something else')}, not a file")


def folder_of(configured: str | None, name: str) -> Path:
    """Return the folder in use: the configured one, or ``name`` in the state directory.

    The state directory is that of the service, or of the user without systemd.
    """
    if configured is not None:
        return Path(configured)
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if state:
        return Path(state) / name
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "rtc3d-gateway" / name
