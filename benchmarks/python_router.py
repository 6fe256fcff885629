"""A Zenoh router that needs no zenohd: a Python session in mode router, until the process is ended.

python -m benchmarks.python_router FILE
"""

import signal
import sys

import zenoh

if __name__ == "__main__":
    ending = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
        signal.sigwait(ending)
