"""``rtc3d-gateway config`` and ``doctor``, and the configuration that the options of a command choose."""

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.errors import ConfigError
from gateway.rtc3d.packets import FIRST_PRINCIPLES_PORT
from gateway.runtime.log_format import LogFormat, LogLevel, set_up_log
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_lines, safe_text
from gateway.tools.cli import options
from gateway.tools.cli.main import print_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from gateway.config.loading import Configuration
    from gateway.outputs.findings import Finding
    from gateway.tools.doctor.report import Report

app = typer.Typer(no_args_is_help=True, help="Check or show a configuration, or print the JSON schema.")


@app.command()
def check(
    file: Annotated[
        Path | None, typer.Argument(help=f"The configuration file to check; the default is {DEFAULT_CONFIG}.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The same as FILE.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing if the file is valid.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check a configuration file and print every mistake with its line. Starts nothing."""
    from gateway.config.loading import read
    from gateway.outputs.registry import settings_type

    if file is not None and config is not None:
        raise typer.BadParameter("give the file once, as FILE or as --config FILE")
    path = chosen_file(file or config, None, wanted="FILE")
    names: list[str] = []
    mistakes: list[str] = []
    try:
        names = [source.name for source in read(path, settings_type()).settings.sources]
    except ConfigError as error:
        if not as_json:
            raise
        mistakes = str(error).splitlines()
    if as_json:
        shown = None if path is None else str(path)
        print_json({"file": shown, "is_valid": not mistakes, "sources": names, "mistakes": mistakes})
    elif not quiet:
        print(f"{path or 'environment'}: valid; {counted(len(names), 'source')}: {', '.join(names)}")
    if mistakes:
        raise typer.Exit(2)


@app.command()
def show(config: options.ConfigOption = None, server: options.ServerOption = None) -> None:
    """Print the effective configuration and where each value comes from. Secrets are masked."""
    from gateway.config.loading import shown_configuration

    print(shown_configuration(configuration_from_options(config, server)), end="")


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors; same as config/gateway.schema.json."""
    from gateway.config.loading import schema_text
    from gateway.outputs.registry import settings_type

    print(schema_text(settings_type()), end="")


_WATCH_S: Final = 3.0


@options.with_options
def doctor(
    config: options.ConfigOption = None,
    server: options.ServerOption = None,
    find: Annotated[
        str | None,
        typer.Option(
            metavar="HOSTS",
            help="Look for RT servers on these hosts: names, addresses, or a subnet such as 192.0.2.0/24, "
            "separated by commas.",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(min=0.1, max=3600, help="How many seconds to watch each source and to wait for Zenoh."),
    ] = _WATCH_S,
    no_connect: Annotated[
        bool,
        typer.Option(
            "--no-connect", help="Ask the running gateway only; open no connection to the RT servers."
        ),
    ] = False,
    subscriber: Annotated[
        bool,
        typer.Option(
            "--subscriber", help="Check the way from gateways to this computer; needs no configuration."
        ),
    ] = False,
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure", help="List every port, who can reach it and what protects it; connect to nothing."
        ),
    ] = False,
    view: Annotated[
        str | None,
        typer.Option(metavar="HOST[:PORT]", help="With --exposure: where `rtc3d-gateway view` listens."),
    ] = None,
    source: options.SourcesOption = None,
    lcm: Annotated[bool, typer.Option("--lcm", help="With --subscriber: receive on LCM, not Zenoh.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log what the checks do, on stderr.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print only warnings and failures; nothing if all is well.")
    ] = False,
    *,
    where: options.AddressOptions,
) -> None:
    """Find out why no data arrives, layer by layer. Exit status 1 if a check fails.

    Without options, it uses the configuration of the installed service. With --subscriber, it checks what
    reaches this computer from gateways and by which routers; --connect and the like say where they are.
    With --exposure, the exit status is 1 if others can control recordings or takes without a password.
    With --find, it is 1 if no RT server answers; only --json and --verbose go with it.
    """
    if find is not None:
        others = (config, server, no_connect, subscriber, exposure, view, source, lcm, quiet)
        is_alone = not any(others) and seconds == _WATCH_S and where == options.AddressOptions()
        _find_servers(find, is_alone=is_alone, as_json=as_json, verbose=verbose)
        return
    options.check_exists("--zenoh-config", where.zenoh_config)
    where.check(lcm=lcm)
    if subscriber and (config or server or no_connect):
        raise typer.BadParameter("--subscriber needs no configuration: leave out --config and --server")
    if not subscriber and (source or lcm or where != options.AddressOptions(zenoh_config=where.zenoh_config)):
        raise typer.BadParameter("--source, --lcm, --connect, --url and --prefix are for --subscriber")
    if (exposure and (subscriber or no_connect or where.zenoh_config)) or (view and not exposure):
        raise typer.BadParameter("--view is for --exposure, which connects to nothing")
    import uvloop
    from rich.console import Console

    from gateway.tools.doctor.report import Report

    # Without --verbose, warnings would repeat the findings.
    set_up_log(LogLevel.DEBUG if verbose else LogLevel.ERROR, LogFormat.TEXT)
    report = Report(Console(quiet=as_json), quiet=quiet)

    to_json: Callable[[], str] = report.as_json
    if exposure:
        to_json = _report_exposure(report, configuration_from_options(config, server), view)
    elif subscriber:
        from gateway.tools.doctor.subscriber_checks import run_subscriber_checks

        for finding in run_subscriber_checks(where.address(lcm=lcm), source or (), seconds):
            report.add(finding)
    else:
        file, connects = chosen_file(config, server), not no_connect
        findings = _check_configuration(file, server, seconds, where.zenoh_config, connects=connects)
        uvloop.run(_report_findings(report, findings, as_json=as_json))
    report.end()
    if as_json:
        print(to_json())
    if not report.is_ok:
        raise typer.Exit(1)


def _find_servers(hosts: str, *, is_alone: bool, as_json: bool, verbose: bool) -> None:
    """Search for RT servers on ``hosts``, and print what was found. Exit status 1 if there is none."""
    if not is_alone:
        raise typer.BadParameter("--find can be combined with --json and --verbose only")
    import uvloop

    from gateway.tools.cli.take import progress_bar
    from gateway.tools.doctor.search import parse_hosts, result_json, result_lines, search

    try:
        names = parse_hosts(hosts)
    except ConfigError as error:
        raise typer.BadParameter(f"--find: {error}") from None
    set_up_log(LogLevel.DEBUG if verbose else LogLevel.ERROR, LogFormat.TEXT)
    with progress_bar(quiet=False, counts_bytes=False) as show:
        result = uvloop.run(search(names, show))
    if as_json:
        print_json(result_json(result))
    else:
        for line in result_lines(result):
            print(safe_text(line))
    if not result.is_ok:
        raise typer.Exit(1)


def _report_exposure(
    report: "Report", configuration: "Configuration", view: str | None
) -> "Callable[[], str]":
    """Report every port of a configuration, and that of the view at HOST[:PORT]; return how to make JSON."""
    from gateway.tools.doctor.exposure import VIEW_PORT, exposed_ports, exposure_findings, exposure_json

    settings = configuration.settings
    ports = list(exposed_ports(settings, _host_and_port(view, VIEW_PORT) if view else None))
    for finding in exposure_findings(settings, ports):
        report.add(finding)
    return partial(exposure_json, ports)


async def _report_findings(report: "Report", findings: "AsyncIterator[Finding]", *, as_json: bool) -> None:
    """Report each finding as soon as it is known."""
    from gateway.tools.doctor.source_checks import CONNECTION

    async for finding in findings:
        report.add(finding)
        if as_json and finding.check == CONNECTION:  # the JSON comes too late to stop the doctor
            print(safe_lines(f"{finding.subject}: {finding.found}"), file=sys.stderr)


async def _check_configuration(
    file: Path | None, server: str | None, seconds: float, zenoh_config: Path | None, *, connects: bool
) -> "AsyncIterator[Finding]":
    """Yield the findings about a configuration, and about the servers and outputs that it names."""
    from gateway.tools.doctor.all_checks import run_checks, run_checks_without_settings

    try:
        settings = configuration_from_options(file, server).settings
    except ConfigError as error:
        for finding in run_checks_without_settings(error):
            yield finding
        return
    origin = str(file or server or "environment")
    sections = {}
    if zenoh_config is not None:
        sections["zenoh"] = settings.outputs["zenoh"].model_copy(update={"config": zenoh_config})
    async for finding in run_checks(settings, origin, seconds, connects=connects, output_sections=sections):
        yield finding


def chosen_file(
    config: Path | None, server: str | None, *, wanted: str = "either --config FILE or --server HOST[:PORT]"
) -> Path | None:
    """Return the configuration file to read: that of ``--config``, or the default if there is neither option.

    None means ``--server``, or that environment variables alone are the configuration. Raises BadParameter if
    both options are given, or if there is nothing to read; ``wanted`` is what should have been given.
    """
    if config is not None and server is not None:
        raise typer.BadParameter(f"give {wanted}")
    if config is not None or server is not None:
        return config
    if DEFAULT_CONFIG.exists():
        return DEFAULT_CONFIG
    if not any(name.startswith(VARIABLE_PREFIX) for name in os.environ):
        raise typer.BadParameter(f"give {wanted}; the default, {DEFAULT_CONFIG}, does not exist")
    return None


def configuration_from_options(config: Path | None, server: str | None) -> "Configuration":
    """Return the configuration from ``--config``, ``--server`` or the default file, and the environment.

    Raises ConfigError if it is not valid; BadParameter as ``chosen_file`` does.
    """
    from gateway.config.loading import read, read_server
    from gateway.outputs.registry import settings_type

    file = chosen_file(config, server)
    if server is not None:
        return read_server(*_host_and_port(server, FIRST_PRINCIPLES_PORT), settings_type())
    return read(file, settings_type())


def _host_and_port(server: str, default_port: int) -> tuple[str, int]:
    """Split HOST, HOST:PORT or [IPV6]:PORT."""
    if server.startswith("["):
        host, _, rest = server[1:].partition("]")
        port = rest.removeprefix(":")
    elif server.count(":") == 1:
        host, _, port = server.partition(":")
    else:
        host, port = server, ""
    if not host:
        raise typer.BadParameter(f"{server!r}: the host is missing; give HOST or HOST:PORT")
    if not port:
        return host, default_port
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"{server!r}: the port must be a number from 1 to 65535")
    return host, int(port)
