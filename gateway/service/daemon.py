"""The gateway as a service: what its signals do, and what systemd hears of it."""

import asyncio
import logging
import os
import signal
from collections.abc import Callable

from gateway.config.settings import Settings
from gateway.errors import ConfigError
from gateway.gateway import Gateway
from gateway.service.systemd import Systemd

logger = logging.getLogger(__name__)


async def serve(load: Callable[[], Settings]) -> None:
    """Run a gateway with the settings that ``load`` gives, until SIGTERM or SIGINT.

    SIGHUP loads them anew: what differs is changed over, and what cannot be used is refused whole.
    Raises ConfigError if they cannot be used at the start.
    """
    await _Service(load, Gateway(load())).run()


class _Service:
    def __init__(self, load: Callable[[], Settings], gateway: Gateway) -> None:
        self._load = load
        self._gateway = gateway
        self._systemd = Systemd()
        self._stop = asyncio.Event()
        self._reload_wanted = asyncio.Event()
        self._has_terminal = os.isatty(0)
        self._refusal = ""

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._on_stop)
        loop.add_signal_handler(signal.SIGHUP, self._on_hangup)
        async with asyncio.TaskGroup() as tasks:
            companions = [tasks.create_task(self._keep_systemd_told()), tasks.create_task(self._reload())]
            await self._gateway.run(self._stop)
            for companion in companions:
                companion.cancel()

    def _on_stop(self) -> None:
        self._systemd.stopping()
        self._stop.set()

    def _on_hangup(self) -> None:
        """SIGHUP says that there is a new configuration, or that the terminal has gone."""
        if self._has_terminal and not os.isatty(0):
            self._on_stop()
        else:
            self._reload_wanted.set()

    async def _keep_systemd_told(self) -> None:
        """From the event loop, so that the watchdog bites when that hangs."""
        await self._gateway.opened.wait()
        self._systemd.alive(self._status())
        self._systemd.ready()
        while True:
            await asyncio.sleep(self._systemd.period_s)
            self._systemd.alive(self._status())

    def _status(self) -> str:
        return "; ".join(filter(None, (self._refusal, *self._gateway.lines())))

    async def _reload(self) -> None:
        await self._gateway.opened.wait()
        while True:
            await self._reload_wanted.wait()
            self._reload_wanted.clear()
            self._systemd.reloading()
            await self._change_over()
            self._systemd.alive(self._status())
            self._systemd.ready()

    async def _change_over(self) -> None:
        try:
            # In a thread: frames go on while a large file is read.
            settings = await asyncio.to_thread(self._load)
            changes = await self._gateway.reload(settings)
        except ConfigError as error:
            problems = str(error).splitlines()
            for problem in problems:
                logger.error("new configuration refused: %s", problem)  # noqa: TRY400 - says it all
            self._refusal = f"new configuration refused, the old one runs on: {problems[0]}"
            if len(problems) > 1:
                self._refusal += f" (and {len(problems) - 1} more in the log)"
        else:
            self._refusal = ""
            logger.info("new configuration: %s", ", ".join(changes) or "nothing differs")
