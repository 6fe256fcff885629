"""Mutation tests: change what the code means in about 250 ways, and count what no test notices.

    .venv/bin/python -m tests.mutants
    .venv/bin/python -m tests.mutants stream outputs/zenoh --jobs 4

semantic_mutants.yaml has the mutants: mistakes that a colleague could make and a user would notice. For each,
the tests nearest to its package run in a copy of the tree and in a network namespace of their own.
"""

import argparse
import itertools
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Final, NamedTuple

import yaml

ROOT: Final = Path(__file__).parents[1]
LEAST_PERCENT: Final = 85

TESTS: Final[dict[str, tuple[str, ...]]] = {
    "rtc3d": ("unit/rtc3d/test_* property/*_packets_* property/*_components_*",),
    "session": ("unit/session/test_* unit/daemon/test_*source* property/*_clock_*",),
    "session/server": ("unit/session/server/test_*",),
    "session/c3d_files": ("unit/session/c3d_files/test_*",),
    "publish": ("unit/publish/test_* property/*_pacing_*",),
    "queries": ("unit/queries/test_* unit/daemon/test_source*",),
    "messages": ("unit/messages/test_*",),
    "messages/descriptions": ("unit/messages/descriptions/test_*",),
    "client": ("unit/client/test_*",),
    "runtime": ("unit/runtime/test_*",),
    "tools/replay": ("unit/tools/replay/test_*",),
    "tools/doctor": ("unit/tools/doctor/test_*",),
    "tools/display": ("unit/tools/display/test_* unit/tools/display/*/test_*",),
    "tools/cli": ("unit/tools/cli/test_*",),
    "config": ("unit/config/test_* property/*_config_*",),
    "daemon": ("unit/daemon/test_*",),
    "daemon/monitoring": ("unit/daemon/monitoring/test_*",),
    "takes/export": ("unit/takes/export/test_*",),
    "takes/files": ("unit/takes/files/test_* property/*takes* property/*_components_*",),
} | {
    f"outputs/{path}": (
        f"unit/outputs/{path}/test_* unit/outputs/test_*",
        f"contract/test_* -k {path.split('/')[-1]}",
    )
    for path in (
        "zenoh",
        "lcm",
        "takes",
        *(f"adapters/{name}" for name in ("ros2", "rtc3d", "vrpn", "lsl", "foxglove")),
    )
}
"""The nearest tests of each package, in tests/: patterns of files for one pytest after the other."""

_PYTEST: Final = "tests/with-netns .venv/bin/python -m pytest -x -q -p no:cacheprovider -k"


class Mutant(NamedTuple):
    """One change of meaning: ``old`` occurs once in ``file`` and becomes ``new``."""

    number: int
    file: str
    old: str
    new: str
    changes: str

    @property
    def package(self) -> str:
        return str(Path(self.file).parent).removeprefix("gateway/")

    def __str__(self) -> str:
        before = (ROOT / self.file).read_text(encoding="utf-8").partition(self.old)[0]
        return f"{self.number:4} {self.file}:{before.count(chr(10)) + 1}"

    def mutated(self, text: str) -> str:
        """Return the text of the file with the change. Raises ValueError if it does not fit."""
        if text.count(self.old) != 1:
            raise ValueError(f"{self.file} has this {text.count(self.old)} times, not once: {self.old!r}")
        return text.replace(self.old, self.new)


class Result(NamedTuple):
    """``outcome`` is killed, hung, SURVIVED or error; ``test`` failed first, or says what went wrong."""

    outcome: str
    test: str = ""
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"{self.outcome} {self.test} ({self.seconds:.0f} s)"


class Runner:
    """Runs tests in copies of the tree; ``jobs`` threads may call ``run`` at once."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self._times = itertools.count(int(time.time()))  # each text of a file needs another .pyc
        self._copies: SimpleQueue[Path] = SimpleQueue()
        copy_files = "git ls-files -z | tar --create --null --files-from=- | tar --extract --directory"
        for copy in [folder / str(number) for number in range(jobs)]:
            copy.mkdir()
            subprocess.run(["sh", "-c", f'{copy_files} "$0"', copy], cwd=ROOT, check=True)
            (copy / ".venv").symlink_to((ROOT / ".venv").resolve())
            self._copies.put(copy)

    def run(self, package: str, mutant: Mutant | None = None, limit_s: float = 3600.0) -> Result:
        """Run the tests of a package, with a mutant or without one, for ``limit_s`` at most."""
        copy, began_s, result = self._copies.get(), time.monotonic(), Result("SURVIVED")
        file = copy / ("LICENSE" if mutant is None else mutant.file)
        original = file.read_text(encoding="utf-8")
        try:
            self._write(file, original if mutant is None else mutant.mutated(original))
            for arguments in TESTS[package]:
                if result.outcome == "SURVIVED":
                    result = _run_pytest(copy, arguments, file.stem, began_s + limit_s - time.monotonic())
            return result._replace(seconds=time.monotonic() - began_s)
        finally:
            self._write(file, original)
            self._copies.put(copy)

    def _write(self, file: Path, text: str) -> None:
        file.write_text(text, encoding="utf-8")
        os.utime(file, (written_s := next(self._times), written_s))


def _run_pytest(copy: Path, arguments: str, stem: str, limit_s: float) -> Result:
    """Run one pytest; the files named after the mutant's come first."""
    patterns, _, selected = arguments.partition(" -k ")
    files = [file for each in patterns.split() for file in (copy / "tests").glob(f"{each}.py")]
    files.sort(key=lambda file: (stem not in file.name, file))
    command = [*_PYTEST.split(), selected, *map(str, files)]
    env = os.environ | {"PYTHONPATH": f"{copy}:{copy}/lcm_types"}  # also for the processes that tests start
    with tempfile.TemporaryFile("w+") as output:  # no pipe, which a process may hold that a test left
        try:
            pytest = subprocess.run(
                command, cwd=copy, env=env, timeout=limit_s, stdout=output, stderr=output, check=False
            )
        except subprocess.TimeoutExpired:
            return Result("hung", "all tests together")
        output.seek(0)
        text = output.read()
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", text, re.MULTILINE)
    if pytest.returncode == 0:
        return Result("SURVIVED")
    if failed is None:
        return Result("error", f"pytest ended with status {pytest.returncode}: {text[-500:]}")
    return Result("hung" if "Failed: Timeout (>" in text else "killed", failed[1])


def load() -> list[Mutant]:
    """Return all mutants. Raises ValueError and SyntaxError, which name the first that does not fit."""
    entries = yaml.safe_load((ROOT / "tests/semantic_mutants.yaml").read_text(encoding="utf-8"))
    mutants = [Mutant(number, **entry) for number, entry in enumerate(entries, start=1)]
    for each in mutants:
        if each.package not in TESTS:
            raise ValueError(f"{each.file} has a mutant, and TESTS names no tests of {each.package}")
        compile(each.mutated((ROOT / each.file).read_text(encoding="utf-8")), str(each), "exec")
    return mutants


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants")
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=f"{', '.join(TESTS)}; default: all")
    parser.add_argument("--mutant", type=int, action="append", metavar="N", help="only this one; repeatable")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="how many to run at once")
    arguments = parser.parse_args()
    if unknown := set(arguments.packages) - set(TESTS):
        parser.error(f"unknown package {', '.join(sorted(unknown))}; known are {', '.join(TESTS)}")
    mutants: dict[str, list[Mutant]] = {}
    for mutant in load():
        is_package = mutant.package in (arguments.packages or TESTS)
        if is_package and mutant.number in (arguments.mutant or [mutant.number]):
            mutants.setdefault(mutant.package, []).append(mutant)
    results: dict[Mutant, Result] = {}
    broken = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        runner = Runner(Path(folder), arguments.jobs)
        try:
            for package, own in mutants.items():
                control = pool.submit(runner.run, package).result()
                print(f"{package} without a mutant: {control}", flush=True)
                if control.outcome != "SURVIVED":
                    broken.append(package)
                    continue
                limit_s = 60 + 6 * control.seconds  # tests that take longer hang
                for mutant, done in [(each, pool.submit(runner.run, package, each, limit_s)) for each in own]:
                    results[mutant] = done.result()
                    print(f"{mutant}: {results[mutant]}", flush=True)
        except KeyboardInterrupt:  # pytest gets it, too
            pool.shutdown(cancel_futures=True)
            sys.exit(130)
    sys.exit(_report(results, broken))


def _report(results: dict[Mutant, Result], broken: Sequence[str]) -> int:
    """Print the figures and the survivors; return the exit status."""
    outcomes = Counter((each.package, result.outcome) for each, result in results.items())
    outcomes.update(("all", result.outcome) for result in results.values())
    percent = 0.0
    print(f"\n{'package':<26} mutants  killed  hung  survived  error      %")
    for package in (*TESTS, "all"):
        counts = [outcomes[package, each] for each in ("killed", "hung", "SURVIVED", "error")]
        if any(counts):
            percent = 100 * sum(counts[:2]) / sum(counts)  # a mutant that hangs would be noticed, too
            print("{:<26}{:8}{:8}{:6}{:10}{:7}{:7.1f}".format(package, sum(counts), *counts, percent))
    for mutant, result in results.items():
        if result.outcome not in {"killed", "hung"}:
            print(f"\n{mutant}: {result.outcome}\n{mutant.changes}\n- {mutant.old}\n+ {mutant.new}")
    if broken:
        print(f"\nThese fail without a mutant, so their mutants do not count: {', '.join(broken)}")
    return int(bool(broken or outcomes["all", "error"]) or percent < LEAST_PERCENT)


if __name__ == "__main__":
    main()
