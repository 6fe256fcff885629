"""The command ``view`` in a process that the kernel kills when the one that started it ends."""

import ctypes
import runpy
import signal
from typing import Final

_PR_SET_PDEATHSIG: Final = 1

if __name__ == "__main__":
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
    runpy.run_module("gateway", run_name="__main__")
