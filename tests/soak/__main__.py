"""Run random faults and attacks for a long time, and report what was lost, and the memory used.

make soak SOAK_MINUTES=30
"""

import argparse
import sys
from pathlib import Path
from typing import Final

import uvloop
from rich.console import Console

from tests.soak.report import report
from tests.soak.soak import Soak

BEGIN: Final = "<!-- soak: begin -->"
END: Final = "<!-- soak: end -->"
"""The lines around the report in its file."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", type=Path, help="the file to put the report into; by default, print it")
    options = parser.parse_args()
    soak = Soak(options.minutes, options.seed)
    uvloop.run(soak.run(Console()))
    text = report(soak)
    if options.report:
        before, _, rest = options.report.read_text().partition(BEGIN)
        _, _, after = rest.partition(END)
        options.report.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}")
        print(f"report in {options.report}")
    else:
        print(text)
    problems = soak.problems()
    if problems:
        sys.exit("; ".join(problems))


if __name__ == "__main__":
    main()
