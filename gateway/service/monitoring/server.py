"""The monitoring server of a gateway: /metrics for Prometheus, /healthz for health checks."""

import asyncio
import logging
from collections.abc import Sequence
from typing import Final

from gateway.config.settings import MetricsSettings
from gateway.errors import system_reason
from gateway.service.gateway import Gateway
from gateway.service.monitoring.health import health_page
from gateway.service.monitoring.http_pages import HttpPages
from gateway.service.monitoring.metrics import metrics_page, metrics_registry
from gateway.service.monitoring.process_limits import DiskFacts, LoopDelay, ProcessLimits
from gateway.stream.tcp import is_address, look_up

_LOOK_UP_TIMEOUT_S: Final = 5.0

logger = logging.getLogger(__name__)


class MonitoringServer:
    """Serves the metrics and the health of one gateway over HTTP."""

    def __init__(
        self, settings: MetricsSettings, gateway: Gateway, limits: ProcessLimits | None = None
    ) -> None:
        limits = limits or ProcessLimits()
        self._settings = settings
        self._loop_delay = LoopDelay()
        self._disk_facts = DiskFacts(gateway)
        self._look_up: asyncio.Task[None] | None = None
        registry = metrics_registry(gateway, self._loop_delay, self._disk_facts)
        self._pages = HttpPages(
            {
                "/metrics": lambda: metrics_page(registry),
                "/healthz": lambda: health_page(gateway, limits.problems()),
            },
            settings.host,
        )

    async def start(self) -> None:
        """Listen if the settings enable it. If the port cannot be bound, log a warning and continue.

        A host name is looked up in the background, so that a name server that does not answer delays nothing.
        """
        if not self._settings.enabled:
            return
        self._loop_delay.start()
        self._disk_facts.start()
        address = self._settings.host
        if is_address(address):
            await self._listen([address])
        else:
            self._look_up = asyncio.create_task(self._look_up_and_listen(address))

    async def _look_up_and_listen(self, name: str) -> None:
        try:
            async with asyncio.timeout(_LOOK_UP_TIMEOUT_S):
                addresses = await look_up(name)
        except OSError as error:  # TimeoutError has no text
            logger.warning(
                "metrics: the host name %s cannot be resolved: %s; continuing without /metrics and /healthz: "
                "check the name server (DNS), or set metrics.host to an IP address, and restart",
                *(name, error.strerror or f"no answer within {_LOOK_UP_TIMEOUT_S:g} s"),
            )
        else:
            await self._listen(addresses)

    async def _listen(self, addresses: Sequence[str]) -> None:
        address, port = self._settings.host, self._settings.port
        try:
            await self._pages.start(addresses, port)
        except OSError as error:
            logger.warning(
                "metrics: cannot listen on %s, port %d: %s; continuing without /metrics and /healthz: "
                "stop the program that uses the port, or set metrics.host and metrics.port, and restart "
                "the gateway",
                *(address, port, system_reason(error)),
            )
        else:
            logger.info("metrics: /metrics and /healthz are served on %s, port %d", address, port)

    async def close(self) -> None:
        """Stop listening."""
        self._loop_delay.close()
        self._disk_facts.close()
        if self._look_up is not None:
            self._look_up.cancel()
        await self._pages.close()
