"""``rtc3d-gateway run``: the gateway itself."""

import uvloop

from gateway.cli.options import (
    ConfigOption,
    LogFormatOption,
    LogLevelOption,
    ServerOption,
    configuration_from_options,
)
from gateway.service.daemon import serve
from gateway.service.log_format import LogFormat, LogLevel, set_up_log


def run(
    config: ConfigOption = None,
    server: ServerOption = None,
    log_level: LogLevelOption = LogLevel.INFO,
    log_format: LogFormatOption = LogFormat.AUTO,
) -> None:
    """Run the gateway until Ctrl-C or SIGTERM. SIGHUP reloads the configuration."""
    set_up_log(log_level, log_format)
    uvloop.run(serve(lambda: configuration_from_options(config, server).settings))
