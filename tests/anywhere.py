"""Run the tests in other surroundings than this machine's, and print a table of the results.

    python -m tests.anywhere [--slow] [NAME ...]

A check on the machine of a developer says little about others: one that has just booted, one in New Zealand,
that of a user with an umlaut in the name. Each of the surroundings here combines several differences; if the
tests fail in one, run them with a single difference to see which it is. It needs root, and Debian's packages
``locales`` and ``python3-venv``.
"""

import argparse
import ctypes
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from release.wheels import find_python

ROOT: Final = Path(__file__).parents[1]
LOCALES: Final = ROOT / "build/locales"
_DAY_S: Final = 86_400
_CLONE_NEWNS, _CLONE_NEWUTS = 0x20000, 0x4000000
_MS_BIND, _MS_REC, _MS_PRIVATE = 0x1000, 0x4000, 0x40000
_USER_ID: Final = 4242


@dataclass(frozen=True)
class Surroundings:
    """What the tests find; ``about`` says it in the table."""

    about: str
    uptime_s: int = 5
    time_zone: str = "UTC"
    locale: str = "C.UTF-8"
    umask: int = 0o022
    user: str = ""
    """A user who is not root, in a home folder of that name. Empty: root."""
    host_name: str = ""
    has_ipv6: bool = True
    order: str = ""
    """A seed for the order of the tests. Empty: the usual order."""
    cores: int = 2
    python: int | None = None
    """The minor version of Python, in an environment of its own. None: that of ``.venv``."""


SURROUNDINGS: Final = {
    "fresh": Surroundings(
        "just booted, Pacific/Chatham, tr_TR.UTF-8, umask 077, a host name of 63 characters, Python 3.13, "
        "random order",
        time_zone="Pacific/Chatham",
        locale="tr_TR.UTF-8",
        umask=0o077,
        host_name="h" * 63,
        order="1",
        python=13,
    ),
    "user": Surroundings(
        "up for 400 days, America/St_Johns, de_DE.UTF-8, no IPv6, the user `Läufer Ä` in a folder of that "
        "name, Python 3.11 of the system, random order",
        uptime_s=400 * _DAY_S,
        time_zone="America/St_Johns",
        locale="de_DE.UTF-8",  # with C, javac and Python's site module cannot read the name of the folder
        has_ipv6=False,
        order="2",
        user="Läufer Ä",
        python=11,
    ),
    "core": Surroundings("one core, LC_ALL=C", locale="C", cores=1),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--slow", action="store_true", help="run the slow tests as well")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(SURROUNDINGS)}; default: all"
    )
    arguments = parser.parse_args()
    if os.geteuid() != 0:
        parser.error("other surroundings need root")
    if unknown := set(arguments.names) - SURROUNDINGS.keys():
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    rows, failed = ["| surroundings | tests | result | duration |", "|---|---|---|--:|"], False
    for name in arguments.names or SURROUNDINGS:
        for target in ("test", "test-slow") if arguments.slow else ("test",):
            about = SURROUNDINGS[name].about
            print(f"=== make {target}: {about}", flush=True)
            began_s = time.monotonic()
            status, result = _run(target, SURROUNDINGS[name])
            minutes, seconds = divmod(round(time.monotonic() - began_s), 60)
            rows.append(f"| {about} | `{target}` | {result} | {minutes} min {seconds} s |")
            failed = failed or status != 0
    commit = subprocess.check_output(["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, text=True).strip()
    print(f"=== at {commit}:", *rows, sep="\n")
    return int(failed)


def _run(target: str, surroundings: Surroundings) -> tuple[int, str]:
    """Run a target of make; return its exit status and the last line of pytest."""
    with _checkout(surroundings) as (folder, python):
        environment = os.environ | {
            "RTC3D_UPTIME_S": str(surroundings.uptime_s),
            "RTC3D_IPV6": "1" if surroundings.has_ipv6 else "0",
            "RTC3D_TEST_ORDER": surroundings.order,
            "TZ": surroundings.time_zone,
            "LC_ALL": surroundings.locale,
            "LOCPATH": str(_make_locale(surroundings.locale)),
            "CI": "",  # what the surroundings lack, such as root or IPv6, they lack on purpose: tests skip
        }
        if surroundings.user:
            environment |= {
                "HOME": str(folder.parent),
                "XDG_CACHE_HOME": str(folder.parent / ".cache"),
                "USER": surroundings.user,
                "LOGNAME": surroundings.user,
            }
        make = subprocess.Popen(
            ["make", "--no-print-directory", *python, target],
            cwd=folder,
            env=environment,
            preexec_fn=lambda: _enter(surroundings),  # noqa: PLW1509  # this program has one thread
            stdout=subprocess.PIPE,
            text=True,
        )
        assert make.stdout is not None
        result = "no summary"
        for line in make.stdout:
            print(line, end="", flush=True)
            if summary := re.fullmatch(r"=* ?(\d+ (?:passed|failed|error).*) in [\d.]+s.*", line.strip()):
                result = summary[1]
        return make.wait(), result


@contextmanager
def _checkout(surroundings: Surroundings) -> Iterator[tuple[Path, list[str]]]:
    """Yield the folder in which to run make, and its arguments that say with which Python."""
    if surroundings.python is None:
        yield ROOT, []
        return
    with tempfile.TemporaryDirectory(dir="/var/tmp") as parent:  # which other users can read
        folder = Path(parent, surroundings.user or "clone", "gateway")
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        if surroundings.user:
            Path(parent).chmod(0o755)
            subprocess.run(["chown", "--recursive", f"{_USER_ID}:{_USER_ID}", str(folder.parent)], check=True)
        yield folder, [f"PYTHON={_find_python(surroundings)}"]


def _find_python(surroundings: Surroundings) -> Path:
    assert surroundings.python is not None
    system = Path(f"/usr/bin/python3.{surroundings.python}")
    if system.exists():
        return system
    found = None if surroundings.user else find_python(surroundings.python)  # it may be in root's home folder
    if found is None:
        sys.exit(
            f"Python 3.{surroundings.python} is missing: install it, with its headers, in /usr or by pyenv"
        )
    return found


def _make_locale(name: str) -> Path:
    """Return a folder with this locale for LOCPATH; the C library has C and C.UTF-8 built in."""
    if not name.startswith("C") and not (LOCALES / name).exists():
        LOCALES.mkdir(parents=True, exist_ok=True)
        language, _, charset = name.partition(".")
        command = ["localedef", "--inputfile", language, "--charmap", charset, str(LOCALES / name)]
        subprocess.run(command, check=True)
    return LOCALES


def _enter(surroundings: Surroundings) -> None:
    """Change this process, which then runs make."""
    libc = ctypes.CDLL(None, use_errno=True)
    os.umask(surroundings.umask)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: surroundings.cores])
    if surroundings.host_name:
        _check(libc.unshare(_CLONE_NEWUTS))
        Path("/proc/sys/kernel/hostname").write_text(surroundings.host_name)
    if surroundings.user:
        _check(libc.unshare(_CLONE_NEWNS))
        _check(libc.mount(None, b"/", None, _MS_REC | _MS_PRIVATE, None))
        # No program makes a user with such a name, but directories of users (LDAP) have them.
        for name, fields in (("passwd", f"x:{_USER_ID}:{_USER_ID}::/:/bin/sh"), ("group", f"x:{_USER_ID}:")):
            with tempfile.NamedTemporaryFile("w", delete=False) as file:
                file.write(Path("/etc", name).read_text() + f"{surroundings.user}:{fields}\n")
            Path(file.name).chmod(0o644)
            _check(libc.mount(os.fsencode(file.name), f"/etc/{name}".encode(), None, _MS_BIND, None))
            Path(file.name).unlink()
        os.setgroups([])
        os.setgid(_USER_ID)
        os.setuid(_USER_ID)


def _check(result: int) -> None:
    if result != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


if __name__ == "__main__":
    sys.exit(main())
