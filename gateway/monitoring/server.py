"""The monitoring server of a gateway: /metrics for Prometheus, /healthz for health checks."""

import logging

from gateway.config.settings import MetricsSettings
from gateway.gateway import Gateway
from gateway.monitoring.health import health_page
from gateway.monitoring.http_pages import HttpPages
from gateway.monitoring.loop_delay import LoopDelay
from gateway.monitoring.metrics import metrics_page, metrics_registry

logger = logging.getLogger(__name__)


class MonitoringServer:
    """Serves the metrics and the health of one gateway over HTTP."""

    def __init__(self, settings: MetricsSettings, gateway: Gateway) -> None:
        self._settings = settings
        self._loop_delay = LoopDelay()
        registry = metrics_registry(gateway, self._loop_delay)
        self._pages = HttpPages(
            {"/metrics": lambda: metrics_page(registry), "/healthz": lambda: health_page(gateway)}
        )

    async def start(self) -> None:
        """Listen if the settings enable it. If the port cannot be bound, log a warning and continue."""
        if not self._settings.enabled:
            return
        address, port = self._settings.address, self._settings.port
        self._loop_delay.start()
        try:
            await self._pages.start(address, port)
        except OSError as error:
            logger.warning(
                "metrics: cannot listen on %s, port %d: %s; continuing without /metrics and /healthz: "
                "stop the program that uses the port, or set metrics.address and metrics.port, and restart "
                "the gateway",
                *(address, port, error.strerror or error),
            )
        else:
            logger.info("metrics: /metrics and /healthz are served on %s, port %d", address, port)

    async def close(self) -> None:
        """Stop listening."""
        self._loop_delay.close()
        await self._pages.close()
