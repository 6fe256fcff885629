"""Build a release twice and compare the check sums of its files.

    build/release-venv/bin/python -m release.reproducible

Each build has a clone of its own. They differ in folder, umask, time zone, language and time.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Final

from release.build import ROOT, run

SURROUNDINGS: Final = (
    ("a", 0o022, {"TZ": "UTC", "LC_ALL": "C.UTF-8"}),
    ("another/and/longer/folder", 0o077, {"TZ": "Asia/Tokyo", "LC_ALL": "C"}),
)
"""For each build: its folder, its umask, and its environment variables."""


def main() -> None:
    """Print which files are the same; end with status 1 if any is not."""
    with tempfile.TemporaryDirectory() as folder:
        builds = []
        for name, umask, variables in SURROUNDINGS:
            clone = Path(folder, name)
            os.umask(umask)
            run("git", "clone", "--quiet", ROOT, clone)
            run("make", "release", cwd=clone, env={**os.environ, **variables})
            builds.append(set((clone / "dist/SHA256SUMS").read_text().splitlines()))
    first, second = builds
    for line in sorted(first & second):
        print("same:", line)
    if different := first ^ second:
        sys.exit("\n".join(f"different: {line}" for line in sorted(different)))


if __name__ == "__main__":
    main()
