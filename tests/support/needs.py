"""What a test needs from the machine. Without it, tests skip on a developer's machine and fail in CI."""

import os
import shutil
import socket
from pathlib import Path


def need(present: object, reason: str) -> None:
    """Go on if the machine has what the test needs; ``reason`` says what that is and how to get it."""
    if present:
        return
    import pytest  # noqa: PLC0415 - it takes long to import, and many processes that tests start import this file

    if os.environ.get("CI") == "true":
        pytest.fail(f"CI must not skip this: {reason}", pytrace=False)
    pytest.skip(reason)


def need_programs(*names: str, packages: str) -> None:
    """Go on if all programs are installed; ``packages`` are those of Debian."""
    missing = [name for name in names if shutil.which(name) is None]
    need(not missing, f"needs {' and '.join(missing)}: install Debian's {packages}")


def is_root() -> bool:
    """Return whether this is root, and not another user in the user namespace of ``tests/with-netns``.

    That one has a single user, who seems to be root there.
    """
    ranges = Path("/proc/self/uid_map").read_text().splitlines()
    return os.geteuid() == 0 and sum(int(each.split()[2]) for each in ranges) > 1


def has_ipv6() -> bool:
    """Return whether the loopback interface has an address of IPv6."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


def need_ipv6() -> None:
    """Go on if the loopback interface has an address of IPv6."""
    need(has_ipv6(), "needs IPv6 on lo")
