"""The program ``rtc3d-gateway``, also started by ``python -m gateway``.

Until Ctrl-C ends the program quietly, this module imports only what Python has imported at its own start: the
others take 0.15 s.
"""

import _signal as signal  # type: ignore[import-not-found] # "signal" imports enum, which takes 10 ms
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> "NoReturn":
    """Run the command line and end the process."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored by nohup, and by shells for `&`
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    _open_standard_streams()
    import gc  # noqa: PLC0415 - see above

    # Importing makes many objects, and next to no garbage: looking for some would take a fifth of the start.
    gc.set_threshold(100_000)
    from gateway.tools.cli.main import main as run_command_line  # noqa: PLC0415 - see above

    run_command_line()


def _open_standard_streams() -> None:
    """Open /dev/null for each standard stream that is closed, as after ``>&-`` in a shell.

    Otherwise, the next socket would get its number, and what a C library prints would go to a server.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - until the end
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - until the end


if __name__ == "__main__":
    main()
