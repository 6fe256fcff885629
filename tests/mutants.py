"""Mutation tests: change the code in thousands of small ways and count the changes that no test notices.

    make mutants PACKAGES="rtc3d publish"
    make mutants PACKAGES=outputs SAMPLE=300

mutmut makes the mutants and runs, for each, the tests that call the changed function; its settings are in
pyproject.toml. This script selects the packages, runs each mutant in a network of its own, prints a table
and writes the diffs of the survivors.
"""

import argparse
import ctypes
import math
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from multiprocessing import Process
from pathlib import Path
from typing import Any, Final

import mutmut.__main__
from mutmut.configuration import config
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.runners.harness import PytestRunner
from mutmut.state import state
from mutmut.utils.file_utils import walk_mutatable_files
from mutmut.workers.isolation import ForkServerRunner
from rich.console import Console
from rich.table import Table

TESTS: Final = {
    "rtc3d": ("tests/unit/rtc3d", "tests/unit/rtc3d_server"),
    "stream": ("tests/unit/stream",),
    "publish": ("tests/unit/publish",),
    "outputs": (
        "tests/unit/outputs",
        "tests/unit/config/test_loading.py",
        "tests/unit/config/test_secrets.py",
        "tests/unit/config/test_settings.py",
        "tests/unit/config/test_show.py",
        "tests/unit/config/test_values.py",
        "tests/contract",
        "tests/integration/test_parameters_published.py",
        "tests/integration/test_query_troubles.py",
        "tests/integration/test_zenoh_queries.py",
        "tests/integration/test_zenoh_queries_keys.py",
        "tests/integration/test_zenoh_selectors.py",
        "tests/integration/test_lcm_queries.py",
        "tests/integration/commands/test_doctor_outputs.py",
    ),
}
"""The packages that are mutated, and the tests that should notice."""

CHILDREN_PER_CORE: Final = 2
"""How many mutants to run at once, if each can have a network of its own. Most tests only wait."""

_CLONE_NEWNET: Final = 0x40000000  # of unshare(2)

OUTPUT: Final = Path("mutants")
SURVIVORS: Final = OUTPUT / "survivors.diff"

COLUMNS: Final = ("killed", "timeout", "survived", "untested", "error")
OUTCOMES: Final = {
    1: "killed",
    3: "killed",
    -24: "timeout",
    -9: "timeout",
    0: "survived",
    33: "untested",
    None: "not run",
}
"""What the exit status of a mutant's tests means: pytest's, a signal's, or mutmut's own 33.

A mutant that is not in the sample has no status. Any other status is an error.
"""


def main() -> None:
    parser = argparse.ArgumentParser(prog="make mutants")
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=f"{', '.join(TESTS)}; default: all")
    parser.add_argument("--sample", type=int, metavar="N", help="run N random mutants of each package")
    parser.add_argument("--seed", type=int, default=1, help="another seed selects another sample")
    arguments = parser.parse_args()
    packages = arguments.packages or list(TESTS)
    if unknown := set(packages) - set(TESTS):
        parser.error(f"unknown package {', '.join(sorted(unknown))}; known are {', '.join(TESTS)}")
    # Results of an earlier run would be kept although the tests have changed.
    shutil.rmtree(OUTPUT, ignore_errors=True)
    _run_fast_tests_first()
    if arguments.sample:
        _run_only_a_sample(arguments.sample, arguments.seed)
    num_children = 1  # the mutants share a network, and LCM's multicast reaches every listener in it
    if os.environ.get("RTC3D_NETNS") == "1":
        _run_in_own_networks()
        num_children = CHILDREN_PER_CORE * len(os.sched_getaffinity(0))
    for package in packages:
        print(f"Package {package}")
        run = Process(target=_run, args=(package, num_children))  # mutmut keeps its state in the process
        run.start()
        run.join()
        if run.exitcode != 0:
            sys.exit(f"mutmut ended with status {run.exitcode}")
    config().only_mutate = [f"gateway/{package}/*" for package in packages]
    results = list(_results())
    _print_table(results)
    SURVIVORS.write_text("\n".join(_survivors(results)))
    print(f"The survivors are in {SURVIVORS}.")


def _run(package: str, num_children: int) -> None:
    config().only_mutate = [f"gateway/{package}/*"]
    config().pytest_add_cli_args_test_selection = list(TESTS[package])
    mutmut.__main__.cli(["run", "--max-children", str(num_children)], standalone_mode=False)


def _run_fast_tests_first() -> None:
    """Sort each mutant's tests by duration, because the first failure ends them."""
    submit = ForkServerRunner.submit

    def sort_and_submit(runner: ForkServerRunner, mutant: str, tests: list[str], *limits: Any) -> None:
        tests = sorted(tests, key=state().duration_by_test.__getitem__)
        submit(runner, mutant, list(dict.fromkeys(map(_selectable, tests))), *limits)

    ForkServerRunner.submit = sort_and_submit


def _selectable(test: str) -> str:
    """Return a name by which pytest finds a test; without its parameters if these contain a backslash.

    pytest escapes backslashes and characters outside ASCII when it collects the tests, and again when it
    looks for the name.
    """
    return test.partition("[")[0] if "\\" in test else test


def _run_only_a_sample(size: int, seed: int) -> None:
    """Select mutants uniformly at random; the same code and seed give the same sample."""
    collect = mutmut.__main__.collect_source_file_mutation_data

    def collect_sample(**names: Any) -> tuple[list[Any], dict[str, SourceFileMutationData]]:
        mutants, files = collect(**names)
        mutants.sort(key=lambda mutant: mutant[1])
        return random.Random(seed).sample(mutants, min(size, len(mutants))), files

    mutmut.__main__.collect_source_file_mutation_data = collect_sample


def _run_in_own_networks() -> None:
    """Run each mutant's tests in a network namespace of their own, set up as tests/with-netns does."""
    run_tests = PytestRunner.run_tests

    def enter_network_and_run(runner: PytestRunner, **tests: Any) -> int:
        if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), "unshare")
        subprocess.run(["ip", "link", "set", "lo", "up", "multicast", "on"], check=True)
        subprocess.run(["ip", "route", "add", "224.0.0.0/4", "dev", "lo"], check=True)
        return int(run_tests(runner, **tests))

    PytestRunner.run_tests = enter_network_and_run


def _results() -> Iterator[tuple[Path, dict[str, str]]]:
    """Yield each source file that has mutants, with the outcome of each mutant by name."""
    for path in sorted(walk_mutatable_files()):
        data = SourceFileMutationData(path=path)
        data.load()
        if data.exit_code_by_key:
            yield path, {name: OUTCOMES.get(code, "error") for name, code in data.exit_code_by_key.items()}


def _print_table(results: list[tuple[Path, dict[str, str]]]) -> None:
    table = Table("module", "mutants", "run", *COLUMNS, "%")
    for column in table.columns:
        column.no_wrap = True
        column.justify = "left" if column is table.columns[0] else "right"
    packages: dict[str, Counter[str]] = {}
    for path, outcomes in results:
        package = path.parts[1]
        if packages and package not in packages:
            table.add_section()
        counts = Counter(outcomes.values())
        packages.setdefault(package, Counter()).update(counts)
        table.add_row(str(path.relative_to("gateway")), *_figures(counts))
    table.add_section()
    for package, counts in packages.items():
        table.add_row(f"[bold]{package}[/bold]", *_figures(counts))
    table.add_row("[bold]all[/bold]", *_figures(sum(packages.values(), Counter())))
    Console(width=110).print(table)
    for package, counts in packages.items():
        if counts["not run"]:
            _print_interval(package, counts)


def _figures(counts: Counter[str]) -> list[str]:
    """Return the cells of one row; a mutant whose tests hang is as good as killed."""
    num_run = counts.total() - counts["not run"]
    share = f"{_num_killed(counts) / num_run:.1%}" if num_run else ""
    return [str(counts.total()), str(num_run), *(str(counts[column]) for column in COLUMNS), share]


def _num_killed(counts: Counter[str]) -> int:
    return counts["killed"] + counts["timeout"]


def _print_interval(package: str, counts: Counter[str]) -> None:
    """Print what a sample says about all mutants of a package: Wilson's interval."""
    size, z = counts.total() - counts["not run"], 1.96
    share = _num_killed(counts) / size
    middle = share + z**2 / (2 * size)
    half = z * math.sqrt(share * (1 - share) / size + z**2 / (4 * size**2))
    low, high = ((middle + sign * half) / (1 + z**2 / size) for sign in (-1, 1))
    print(f"{package}: a sample; of all mutants, {low:.1%} to {high:.1%} are killed, with 95 % confidence.")


def _survivors(results: list[tuple[Path, dict[str, str]]]) -> Iterator[str]:
    for path, outcomes in results:
        for name, outcome in outcomes.items():
            if outcome not in {"killed", "timeout", "not run"}:
                yield f"# {name}: {outcome}\n{get_diff_for_mutant(name, path=path)}"


if __name__ == "__main__":
    main()
