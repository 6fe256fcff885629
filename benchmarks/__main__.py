"""Run all benchmarks or some of them. Use tests/with-netns, as `make bench` does.

python -m benchmarks [--quick | --render] [PART ...]
"""

import argparse
import sys

from rich.console import Console

from benchmarks import processes, report


def main() -> int:
    """Measure, store the results, print the tables, and update them in the document."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"what to measure: {', '.join(report.PARTS)} (default: all)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="measure briefly and leave the document unchanged"
    )
    parser.add_argument(
        "--render", action="store_true", help="do not measure, only update the tables in the document"
    )
    options = parser.parse_args()
    if unknown := set(options.parts) - set(report.PARTS):
        parser.error(f"unknown part: {', '.join(sorted(unknown))}")
    file = report.QUICK_RESULTS if options.quick else report.RESULTS
    selected = [
        name for name in report.PARTS if name in (options.parts or report.PARTS) and not options.render
    ]
    processes.leave_measured_core()
    progress = report.Progress({name: report.part(name).expected_s(options.quick) for name in selected})
    for name in selected:
        progress.begin(name)
        report.merge(file, name, report.part(name).measure(options.quick, progress))
    sections = report.sections(report.load(file))
    for name in ("machine", *(selected or report.PARTS), "goals"):
        for table in sections.get(name, []):
            table.show(Console())
    if not options.quick:
        report.DOCUMENT.write_text(report.rendered(report.DOCUMENT.read_text(), sections))
    return 0


if __name__ == "__main__":
    sys.exit(main())
