"""Run the benchmarks with two sites, or some of them. Use tests/with-netns, as `make bench-sites` does.

python -m benchmarks.sites [--quick | --render] [PART ...]
"""

import sys

from benchmarks import suite

if __name__ == "__main__":
    sys.exit(suite.run(suite.SITES))
