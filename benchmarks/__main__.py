"""The benchmarks, all or those named; run them within tests/with-netns, as `make bench` does.

python -m benchmarks [--quick | --render] [PART ...]
"""

import argparse
import sys

from rich.console import Console

from benchmarks import parts, processes, report


def main() -> int:
    """Measure, keep the figures, print the tables, and put them into the document."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(parts.NAMES)}; all unless given"
    )
    parser.add_argument("--quick", action="store_true", help="rough figures, which the document does not get")
    parser.add_argument(
        "--render", action="store_true", help="measure nothing, only write the document's tables"
    )
    options = parser.parse_args()
    if unknown := set(options.parts) - set(parts.NAMES):
        parser.error(f"there is no part {', '.join(sorted(unknown))}")
    file = report.QUICK_RESULTS if options.quick else report.RESULTS
    chosen = [name for name in parts.NAMES if name in (options.parts or parts.NAMES) and not options.render]
    processes.leave_measured_core()
    progress = report.Progress({name: parts.part(name).expected_s(options.quick) for name in chosen})
    for name in chosen:
        progress.begin(name)
        report.merge(file, name, parts.part(name).measure(options.quick, progress))
    shown = parts.sections(report.load(file))
    for name in ("machine", *(chosen or parts.NAMES), "goals"):
        for table in shown.get(name, []):
            table.show(Console())
    if not options.quick:
        report.DOCUMENT.write_text(report.rendered(report.DOCUMENT.read_text(), shown))
    return 0


if __name__ == "__main__":
    sys.exit(main())
