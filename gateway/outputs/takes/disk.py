"""Whether the disk accepts what is written to it."""

import errno
import logging
from pathlib import Path
from typing import Final

from gateway.log import HOLD_S, FailureLog

RETRY_S: Final = 0.25
"""How often what the disk did not accept is written again."""

_REMEDIES: Final = {
    errno.ENOSPC: "make room on it, or lower takes.max_bytes",
    errno.EDQUOT: "make room on it, or lower takes.max_bytes",
    errno.EACCES: "let the gateway write there",
    errno.EPERM: "let the gateway write there",
    errno.EROFS: "mount it so that the gateway can write",
    errno.ENOENT: "is the disk mounted? If so, create the folder, or start the gateway again",
    errno.ENOTDIR: "choose a folder as takes.directory",
}

logger = logging.getLogger(__name__)


def is_full(error: OSError) -> bool:
    """Return whether room on the disk would help."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


class Disk:
    """Remembers and logs the present problem of the disk. Called in the thread that writes."""

    def __init__(self) -> None:
        self.problem = ""
        """What is wrong and what to do; "" if the newest attempt succeeded, and after the end of a file."""
        self._failures = FailureLog(logger, "takes", HOLD_S)

    def failed(self, path: Path, error: OSError) -> None:
        """Note that ``path`` could not be written."""
        self.problem = disk_problem(path, error)
        self._failures.failed(self.problem)

    def ended(self) -> None:
        """Forget the problem, because a file has ended; the next one shows whether it persists."""
        self.problem = ""

    def succeeded(self) -> None:
        """Note that something was written."""
        self.problem = ""
        self._failures.recovered("takes are written again")


def disk_problem(path: Path, error: OSError) -> str:
    """Return what is wrong with ``path``, and what to do."""
    remedy = _REMEDIES.get(error.errno or 0, "check the disk")
    return f"{path} cannot be written: {error.strerror or error}; {remedy}"
