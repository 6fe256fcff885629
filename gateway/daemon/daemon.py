"""The gateway as a daemon: handles signals, reloads the configuration and notifies systemd.

The notifications need cysystemd, which contains libsystemd. It is installed with the optional extra
``systemd``, because it has no wheels for platforms without systemd, such as Alpine containers.
"""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable
from typing import Any, Final

from gateway.config.settings import Settings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.process_limits import (
    ProcessLimits,
    limit_kept_memory,
    raise_file_limit,
    return_free_memory,
)
from gateway.daemon.monitoring.server import MonitoringServer, status_lines
from gateway.errors import ConfigError
from gateway.runtime.failures import DefectLog, FailureLog, defect_text
from gateway.runtime.process_end import Signals, named_tasks
from gateway.runtime.workers import WorkerThread

_DEFAULT_PERIOD_S: Final = 1.0
_RETURN_MEMORY_S: Final = 60.0

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

    def notify_alive(self, status: str) -> None:
        """Reset the watchdog and set the line that ``systemctl status`` shows."""
        self.notify("WATCHDOG")
        self.notify("STATUS", " ".join(status.split()))

    def notify(self, name: str, value: str = "") -> None:
        """Send READY once the start or a reload is complete, and RELOADING or STOPPING when that begins."""
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
            self._failures.failed(f"cannot send {name}: {error}", reason=str(error))


async def serve(load: Callable[[], Settings], every_second: Callable[[], None] = lambda: None) -> None:
    """Run a gateway with the settings that ``load`` returns, until SIGTERM or SIGINT.

    SIGHUP calls ``load`` again and applies the changes; a configuration with an error is refused as a whole.
    ``every_second`` is called about once a second.
    Raises ConfigError if the settings cannot be used at the start.
    """
    raise_file_limit()
    limit_kept_memory()
    daemon = Daemon(load, Gateway(load()), every_second)
    in_loop = asyncio.get_running_loop().call_soon_threadsafe
    Signals(lambda: in_loop(daemon.request_stop), lambda: in_loop(daemon.hang_up), daemon.unfinished)
    await daemon.run()


async def _return_memory() -> None:
    thread = WorkerThread("memory")
    while True:
        await asyncio.sleep(_RETURN_MEMORY_S)
        with contextlib.suppress(OSError):  # no thread can be started, which the status says
            await thread.run(return_free_memory)


class Daemon:
    """Runs one gateway for the lifetime of the process; ``load`` returns its current settings.

    ``every_second`` is called about once a second.
    """

    def __init__(
        self, load: Callable[[], Settings], gateway: Gateway, every_second: Callable[[], None] = lambda: None
    ) -> None:
        self._load = load
        self._gateway = gateway
        self._every_second = every_second
        self._defects = DefectLog(logger, "gateway")
        self._limits = ProcessLimits()
        self._monitoring = MonitoringServer(gateway.settings.metrics, gateway, self._limits)
        self._systemd = SystemdNotifier()
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        self._reload_requested = asyncio.Event()
        self._started_on_terminal = os.isatty(0)
        self._reload_problem = ""
        """Why the last reload was refused; "" if it succeeded."""

    async def run(self) -> None:
        """Run until ``request_stop`` is called."""
        self._loop.set_exception_handler(self._on_loop_error)
        async with asyncio.TaskGroup() as tasks:
            background = [
                tasks.create_task(self._notify_systemd()),
                tasks.create_task(self._handle_reloads()),
                tasks.create_task(_return_memory()),
            ]
            await self._monitoring.start()
            try:
                await self._gateway.run(self._stop)
            finally:
                await self._monitoring.close()
                for task in background:
                    task.cancel()

    def request_stop(self) -> None:
        """Begin to stop. Called in the event loop."""
        self._systemd.notify("STOPPING")
        self._stop.set()

    def hang_up(self) -> None:
        """Stop if the terminal is gone, which also sends SIGHUP; otherwise reload the configuration."""
        if self._started_on_terminal and not os.isatty(0):
            os.kill(os.getpid(), signal.SIGTERM)  # Signals limits the time that the stop takes
        else:
            self._reload_requested.set()

    def unfinished(self) -> list[str]:
        """Return what a stop still waits for. This may be called in any thread."""
        return named_tasks(self._loop) if self._stop.is_set() else ["the event loop, which is busy"]

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log what a callback or a forgotten task has raised, each defect once (see DefectLog)."""
        defect = context.get("exception")
        if defect is None:
            loop.default_exception_handler(context)
        else:
            self._defects.log(defect)

    async def _notify_systemd(self) -> None:
        """Notify systemd of the start, then periodically of the status.

        This runs in the event loop so that the watchdog restarts the service if the loop hangs.
        """
        await self._gateway.opened.wait()
        self._systemd.notify_alive(self._status_line())
        self._systemd.notify("READY")
        while True:
            await asyncio.sleep(self._systemd.period_s)
            self._systemd.notify_alive(self._status_line())
            self._every_second()

    def _status_line(self) -> str:
        try:
            lines = [*self._limits.problems(), *status_lines(self._gateway)]
        except Exception as defect:  # noqa: BLE001 - what shows the status must not stop the gateway
            self._defects.log(defect)
            lines = [defect_text(defect)]
        return "; ".join(filter(None, (self._reload_problem, *lines)))

    async def _handle_reloads(self) -> None:
        await self._gateway.opened.wait()
        while True:
            await self._reload_requested.wait()
            self._reload_requested.clear()
            self._systemd.notify("RELOADING")
            await self._reload()
            self._systemd.notify_alive(self._status_line())
            self._systemd.notify("READY")

    async def _reload(self) -> None:
        try:
            # in a thread, because reading a file could delay frames
            settings = await WorkerThread("load").run(self._load)
            metrics_before = self._gateway.settings.metrics
            changes = await self._gateway.reload(settings)
            if settings.metrics != metrics_before:
                await self._monitoring.close()
                self._monitoring = MonitoringServer(settings.metrics, self._gateway, self._limits)
                await self._monitoring.start()
                changes.append("metrics changed")
        except ConfigError as error:
            problems = str(error).splitlines()
            for problem in problems:
                logger.error("new configuration refused: %s", problem)  # noqa: TRY400 - no traceback needed
            self._reload_problem = f"new configuration refused, the old one stays in use: {problems[0]}"
            if len(problems) > 1:
                self._reload_problem += f" (and {len(problems) - 1} more in the log)"
        except Exception as defect:  # noqa: BLE001 - what runs continues to run
            self._defects.log(defect)
            self._reload_problem = f"the configuration was not reloaded completely: {defect_text(defect)}"
        else:
            self._reload_problem = ""
            logger.info("configuration reloaded: %s", ", ".join(changes) or "nothing changed")
