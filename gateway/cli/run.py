"""``rtc3d-gateway run``: run the gateway."""

import gc
import logging
import os
import select
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Final

from gateway.cli.options import ConfigOption, LogOptions, ServerOption, with_options
from gateway.logs.log_format import LogLimit, set_up_log
from gateway.service.process_end import end_at_once


class StopSignals:
    """Waits for Ctrl-C, SIGTERM or SIGHUP; the second one calls ``end_at_once``, which ends the process.

    A threading.Event cannot be set in a signal handler: the handler may interrupt its ``wait`` while that
    holds the lock that ``set`` needs. A pipe has no lock. Create it in the main thread.
    """

    def __init__(self, end_at_once: Callable[[int], object]) -> None:
        self._end_at_once = end_at_once
        self._is_set = False
        self._reading, self._writing = os.pipe()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, and shells for `&`
                signal.signal(number, self._handle)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the first signal; return whether it has come."""
        return bool(select.select([self._reading], [], [], timeout_s)[0])

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if self._is_set:
            self._end_at_once(number)
        self._is_set = True
        os.write(self._writing, b"\0")


logger = logging.getLogger(__name__)

SWITCH_INTERVAL_S: Final = 0.0005
"""How long a thread that runs Python keeps the event loop waiting for its lock. Every message to an output
releases that lock once, so that the default of 5 ms would add up to more than the time between two frames."""


@with_options
def run(
    *,
    config: ConfigOption = None,
    server: ServerOption = None,
    log: LogOptions,
) -> None:
    """Run the gateway until Ctrl-C or SIGTERM. SIGHUP reloads the configuration."""
    for number in (signal.SIGINT, signal.SIGTERM):  # until the daemon handles them
        signal.signal(number, end_at_once)
    level = log.chosen_level()
    import uvloop

    from gateway.cli.config import chosen_file, configuration_from_options
    from gateway.service.daemon import serve

    limit = LogLimit()
    set_up_log(level, log.log_format, limit)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    # The objects of all modules stay until the end. Without this, each full garbage collection looks through
    # them and stops the event loop for some 20 ms; many tiny packets cause one every second.
    gc.freeze()
    file = chosen_file(config, server)
    if file is not None and config is None:
        logger.info("the configuration is %s, because none was given", file)
    uvloop.run(serve(lambda: configuration_from_options(file, server).settings, limit.report))
    limit.report(at_once=True)
