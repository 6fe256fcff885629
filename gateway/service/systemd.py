"""What systemd is told of the service (sd_notify); nothing happens without it ($NOTIFY_SOCKET unset).

cysystemd, the extra ``systemd``, brings libsystemd along. It is no dependency of the package itself,
because it has no wheels where there is no systemd: for Alpine's containers, for instance.
"""

import logging
import os
from typing import Final

from gateway.log import FailureLog

_DEFAULT_PERIOD_S: Final = 1.0

logger = logging.getLogger(__name__)


class Systemd:
    """The service manager that started this process, if one did."""

    def __init__(self) -> None:
        self._is_there = bool(os.environ.get("NOTIFY_SOCKET"))
        self._telling = FailureLog(logger, "systemd")

    @property
    def period_s(self) -> float:
        """How often ``alive`` is to be called: once a second, or twice within the unit's WatchdogSec."""
        # WATCHDOG_PID: the variables may have been inherited from a parent that they were meant for.
        if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
            return _DEFAULT_PERIOD_S
        watchdog_us = int(os.environ.get("WATCHDOG_USEC", "0"))
        return min(_DEFAULT_PERIOD_S, watchdog_us / 2e6) if watchdog_us else _DEFAULT_PERIOD_S

    def ready(self) -> None:
        """Tell that the start, or a reload, is over."""
        self._tell("READY")

    def reloading(self) -> None:
        """Tell that a reload begins; ``ready`` ends it."""
        self._tell("RELOADING")

    def stopping(self) -> None:
        """Tell that the service is about to end."""
        self._tell("STOPPING")

    def alive(self, status: str) -> None:
        """Feed the watchdog, and give the line that ``systemctl status`` shows."""
        self._tell("WATCHDOG")
        self._tell("STATUS", " ".join(status.split()))

    def _tell(self, name: str, value: str = "") -> None:
        if not self._is_there:
            return
        try:
            from cysystemd.daemon import Notification, notify  # noqa: PLC0415 - an optional extra

            notify(Notification[name], value, return_exceptions=False)
        except ImportError:
            self._is_there = False
            logger.warning(
                "systemd waits to be told how the service is, and cannot be: "
                "pip install 'rtc3d-gateway[systemd]', or set Type=exec in the unit and no WatchdogSec"
            )
        except (OSError, RuntimeError, ValueError) as error:  # the last two are cysystemd's own
            self._telling.failed(f"not told {name}: {error}")
