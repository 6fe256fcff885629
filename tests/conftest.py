"""The event loop of the tests, and checks of what they need from the machine.

Where something is missing, tests skip on a developer's machine and fail in CI.
"""

import asyncio
import gc
import itertools
import os
import random
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest
import uvloop
from hypothesis import HealthCheck, settings
from hypothesis.database import DirectoryBasedExampleDatabase
from xdist.scheduler import LoadScopeScheduling, Scheduling

from gateway.runtime.failures import HOLD_S
from tests.support.needs import is_root, need

# uvloop starts a process by a fork, after which Python runs in the child for a moment. A garbage collection
# that finds a Zenoh session there waits for threads that the child does not have; the parent waits for it.
os.register_at_fork(before=gc.disable, after_in_parent=gc.enable)

# Thousands of tests are many objects that stay: looking through them for garbage would take a fifth of the
# CPU time of a run. See also pytest_collection_finish.
gc.set_threshold(20_000)

# A deadline would fail on a busy machine. The same examples in each run: `make fuzz` looks for new ones.
settings.register_profile("gateway", deadline=None, derandomize=True, database=None)
settings.register_profile(
    "fuzz",
    settings.get_profile("gateway"),
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "2000")),
    derandomize=False,
    database=DirectoryBasedExampleDatabase("build/fuzz/examples"),  # what failed comes first in the next run
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("gateway")  # the option --hypothesis-profile loads another one after this

_WHEELHOUSE: Final = Path(__file__).parents[1] / "build/wheelhouse/complete"

_GROUPS: Final = {
    "machine": ("tests/systemd/",),
    "package": ("tests/release/test_debian_package.py", "tests/release/test_package_build.py"),
    "release": ("tests/release/",),
    "outages": ("tests/outages/",),
    "sites": ("tests/hostile/test_sites.py",),
    "proxy": ("tests/hostile/test_https_proxy.py",),
    "browser": ("tests/view/", "tests/site/"),
    "examples": tuple(f"tests/languages/test_{name}.py" for name in ("examples", "gaps", "live_examples")),
}

_NEEDS: Final = {
    "netns": (
        os.environ.get("RTC3D_NETNS") == "1",
        "needs a network namespace: allow user namespaces, or be root",
    ),
    "takes": (
        bool(os.environ.get("RTC3D_TAKES")),
        "needs recordings: set RTC3D_TAKES to a folder with optotrak.c3d and qualisys.c3d",
    ),
    "wheelhouse": (
        _WHEELHOUSE.exists(),
        "installs from build/wheelhouse without a network: run make wheelhouse first",
    ),
    "chromium": (
        Path("/usr/bin/chromium").exists(),
        "needs a browser: install Debian's package chromium",
    ),
    "systemd": (
        is_root() and Path("/lib/systemd/systemd").exists(),
        "boots its own systemd: needs root and an installed systemd",
    ),
}
"""For each marker: whether the machine has what it needs, and what to do if not."""


def pytest_configure(config: pytest.Config) -> None:
    """Take a worker's connection to pytest away from the processes that it forks.

    Otherwise pytest would not notice the end of a worker that crashes, or is ended by its time-out, while one
    of them lives.
    """
    for plugin in config.pluginmanager.get_plugins():
        if type(plugin).__name__ == "WorkerInteractor":
            connection = plugin.channel.gateway._io
            null = os.open(os.devnull, os.O_RDWR)
            for file in (connection.infile, connection.outfile):
                os.register_at_fork(after_in_child=partial(os.dup2, null, file.fileno()))


def pytest_collection_finish() -> None:
    """Leave what pytest has collected out of further garbage collections."""
    gc.freeze()


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"uvloop": uvloop.new_event_loop}


class _Scheduler(LoadScopeScheduling):  # type: ignore[misc]  # it has no types
    """Runs some groups of tests in one worker each.

    Otherwise each worker would install on a machine of its own, start a browser, and run gateways for the
    examples. Each of the outages needs a core. Those of two sites share both of them.
    pytest-xdist's own groups have no effect with pytest 9.2.
    """

    def _split_scope(self, nodeid: str) -> str:
        return next((name for name, paths in _GROUPS.items() if nodeid.startswith(paths)), nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling | None:
    return _Scheduler(config, log) if config.getvalue("dist") == "loadgroup" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mix the modules: many in a row that wait leave the cores idle, and many that compute crowd them.

    If RTC3D_TEST_ORDER is set to a seed, shuffle the modules, and the tests in each. Those of an installation
    stay in their order: the last one removes it.
    """
    if seed := os.environ.get("RTC3D_TEST_ORDER"):
        order = random.Random(seed)
        in_order = [item for item in items if item.nodeid.startswith("tests/systemd/")]
        fixed = {item: number for number, item in enumerate(in_order)}
        rank = _shuffled(items, order)
        items.sort(key=lambda item: (-1, fixed[item]) if item in fixed else (rank[item.path], order.random()))
    elif hasattr(config, "workerinput") and not config.getvalue("loadgroup"):  # the workers of `make test`
        rank = _shuffled(items, random.Random(0))
        items.sort(key=lambda item: rank[item.path])


def _shuffled(items: list[pytest.Item], order: random.Random) -> dict[Path, int]:
    """Return the place of each module in a random order."""
    modules = sorted({item.path for item in items})
    return dict(zip(modules, order.sample(range(len(modules)), len(modules)), strict=True))


def pytest_runtest_setup(item: pytest.Item) -> None:
    for marker, (present, reason) in _NEEDS.items():
        if item.get_closest_marker(marker) is not None:
            need(present, reason)


@pytest.fixture
def no_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make FailureLog report a recovery at the first success: its clock advances by HOLD_S per reading."""
    monkeypatch.setattr("gateway.runtime.failures.monotonic", itertools.count(0.0, HOLD_S).__next__)
