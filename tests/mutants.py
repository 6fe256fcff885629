"""Mutation tests: change the code in thousands of small ways and count the changes that no test notices.

    make mutants PACKAGES="rtc3d publish"

mutmut makes the mutants and runs, for each, the tests that call the changed function; its settings are in
pyproject.toml. This script selects the packages, prints a table and writes the diffs of the survivors.
"""

import argparse
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from multiprocessing import Process
from pathlib import Path
from typing import Any, Final

from mutmut.__main__ import cli
from mutmut.configuration import config
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
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
        "tests/contract",
        "tests/integration/test_zenoh_queries.py",
        "tests/integration/test_zenoh_queries_keys.py",
        "tests/integration/test_zenoh_selectors.py",
        "tests/integration/test_lcm_queries.py",
        "tests/integration/test_doctor_outputs.py",
    ),
}
"""The packages that are mutated, and the tests that should notice."""

OUTPUT: Final = Path("mutants")
SURVIVORS: Final = OUTPUT / "survivors.diff"

COLUMNS: Final = ("killed", "timeout", "survived", "untested", "error")
OUTCOMES: Final = {1: "killed", 3: "killed", -24: "timeout", -9: "timeout", 0: "survived", 33: "untested"}
"""What the exit status of a mutant's tests means: pytest's, a signal's, or mutmut's own 33.

Any other status is an error. The likely one: the ``ids`` of a parametrized test contain a backslash or a
character that is not ASCII. pytest escapes it when it collects the tests, and again for each mutant, and so
does not find the test.
"""


def main() -> None:
    parser = argparse.ArgumentParser(prog="make mutants")
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=f"{', '.join(TESTS)}; default: all")
    packages = parser.parse_args().packages or list(TESTS)
    if unknown := set(packages) - set(TESTS):
        parser.error(f"unknown package {', '.join(sorted(unknown))}; known are {', '.join(TESTS)}")
    # Results of an earlier run would be kept although the tests have changed.
    shutil.rmtree(OUTPUT, ignore_errors=True)
    _run_fast_tests_first()
    for package in packages:
        print(f"Package {package}")
        run = Process(target=_run, args=(package,))  # mutmut keeps its state in the process
        run.start()
        run.join()
        if run.exitcode != 0:
            sys.exit(f"mutmut ended with status {run.exitcode}")
    config().only_mutate = [f"gateway/{package}/*" for package in packages]
    results = list(_results())
    _print_table(results)
    SURVIVORS.write_text("\n".join(_survivors(results)))
    print(f"The survivors are in {SURVIVORS}.")


def _run(package: str) -> None:
    config().only_mutate = [f"gateway/{package}/*"]
    config().pytest_add_cli_args_test_selection = list(TESTS[package])
    # One at a time: the mutants share a network, and LCM's multicast reaches every listener in it.
    cli(["run", "--max-children", "1"], standalone_mode=False)


def _run_fast_tests_first() -> None:
    """Sort each mutant's tests by duration, because the first failure ends them."""
    submit = ForkServerRunner.submit

    def sort_and_submit(runner: ForkServerRunner, mutant: str, tests: list[str], *limits: Any) -> None:
        submit(runner, mutant, sorted(tests, key=state().duration_by_test.__getitem__), *limits)

    ForkServerRunner.submit = sort_and_submit


def _results() -> Iterator[tuple[Path, dict[str, str]]]:
    """Yield each source file that has mutants, with the outcome of each mutant by name."""
    for path in sorted(walk_mutatable_files()):
        data = SourceFileMutationData(path=path)
        data.load()
        if data.exit_code_by_key:
            yield path, {name: OUTCOMES.get(code, "error") for name, code in data.exit_code_by_key.items()}


def _print_table(results: list[tuple[Path, dict[str, str]]]) -> None:
    table = Table("module", "mutants", *COLUMNS, "%")
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
    Console().print(table)


def _figures(counts: Counter[str]) -> list[str]:
    """Return the cells of one row; a mutant whose tests hang is as good as killed."""
    share = (counts["killed"] + counts["timeout"]) / counts.total()
    return [str(counts.total()), *(str(counts[column]) for column in COLUMNS), f"{share:.1%}"]


def _survivors(results: list[tuple[Path, dict[str, str]]]) -> Iterator[str]:
    for path, outcomes in results:
        for name, outcome in outcomes.items():
            if outcome not in {"killed", "timeout"}:
                yield f"# {name}: {outcome}\n{get_diff_for_mutant(name, path=path)}"


if __name__ == "__main__":
    main()
