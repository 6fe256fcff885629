"""Notifications for systemd (sd_notify), sent only if $NOTIFY_SOCKET is set.

They need cysystemd, which contains libsystemd. It is installed with the optional extra ``systemd``, because
it has no wheels for platforms without systemd, such as Alpine containers.
"""

import logging
import os
from typing import Final

from gateway.log import FailureLog

_DEFAULT_PERIOD_S: Final = 1.0

logger = logging.getLogger(__name__)


class SystemdNotifier:
    """Notifies the systemd that started this process, if one did."""

    def __init__(self) -> None:
        self._enabled = bool(os.environ.get("NOTIFY_SOCKET"))
        self._failures = FailureLog(logger, "systemd")

    @property
    def period_s(self) -> float:
        """How often to call ``notify_alive``: every second, or twice per WatchdogSec if that is shorter."""
        # WATCHDOG_PID names another process if the variables were inherited from a supervised parent.
        if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
            return _DEFAULT_PERIOD_S
        watchdog_us = int(os.environ.get("WATCHDOG_USEC", "0"))
        return min(_DEFAULT_PERIOD_S, watchdog_us / 2e6) if watchdog_us else _DEFAULT_PERIOD_S

    def notify_ready(self) -> None:
        """Report that the start or a reload is complete."""
        self._notify("READY")

    def notify_reloading(self) -> None:
        """Report that a reload begins; ``notify_ready`` ends it."""
        self._notify("RELOADING")

    def notify_stopping(self) -> None:
        """Report that the service is stopping."""
        self._notify("STOPPING")

    def notify_alive(self, status: str) -> None:
        """Reset the watchdog and set the line that ``systemctl status`` shows."""
        self._notify("WATCHDOG")
        self._notify("STATUS", " ".join(status.split()))

    def _notify(self, name: str, value: str = "") -> None:
        if not self._enabled:
            return
        try:
            from cysystemd.daemon import Notification, notify  # noqa: PLC0415 - an optional extra

            notify(Notification[name], value, return_exceptions=False)
        except ImportError:
            self._enabled = False
            logger.warning(
                "systemd expects notifications, but cysystemd is not installed: "
                "pip install 'rtc3d-gateway[systemd]', or set Type=exec and no WatchdogSec in the unit"
            )
        except (OSError, RuntimeError, ValueError) as error:  # the last two come from cysystemd
            self._failures.failed(f"cannot send {name}: {error}")
