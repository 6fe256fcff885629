"""Run all benchmarks or some of them. Use tests/with-netns, as `make bench` does.

python -m benchmarks [--quick | --render] [PART ...]
"""

import sys

from benchmarks import processes, suite

if __name__ == "__main__":
    sys.exit(suite.run(suite.GATEWAY, processes.leave_measured_core))
