"""``rtc3d-gateway doctor``: find out why no data arrives."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gateway.cli.options import ConfigOption, ServerOption, ZenohConfigOption, check_exists
from gateway.errors import ConfigError
from gateway.logs.log_format import LogFormat, LogLevel, set_up_log
from gateway.logs.safe_text import safe_lines

if TYPE_CHECKING:
    from gateway.doctor.report import Report


def doctor(
    config: ConfigOption = None,
    server: ServerOption = None,
    seconds: Annotated[
        float,
        typer.Option(min=0.1, max=3600, help="How many seconds to watch each source and to wait for Zenoh."),
    ] = 3.0,
    no_connect: Annotated[
        bool,
        typer.Option(
            "--no-connect", help="Ask the running gateway only; open no connection to the RT servers."
        ),
    ] = False,
    zenoh_config: ZenohConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log what the checks do, on stderr.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print only warnings and failures; nothing if all is well.")
    ] = False,
) -> None:
    """Find out why no data arrives, layer by layer. Exit status 1 if a check fails.

    Without options, it uses the configuration of the installed service.
    """
    check_exists("--zenoh-config", zenoh_config)
    import uvloop
    from rich.console import Console

    from gateway.doctor.report import Report

    # Without --verbose, warnings would repeat the findings.
    set_up_log(LogLevel.DEBUG if verbose else LogLevel.ERROR, LogFormat.TEXT)
    report = Report(Console(quiet=as_json), quiet=quiet)
    uvloop.run(
        _report_findings(
            report,
            config,
            server,
            seconds,
            connects=not no_connect,
            zenoh_config=zenoh_config,
            as_json=as_json,
        )
    )
    if as_json:
        print(report.as_json())
    if not report.is_ok:
        raise typer.Exit(1)


async def _report_findings(
    report: "Report",
    config: Path | None,
    server: str | None,
    seconds: float,
    *,
    connects: bool,
    zenoh_config: Path | None,
    as_json: bool,
) -> None:
    from gateway.cli.config import chosen_file, configuration_from_options
    from gateway.doctor.all_checks import run_checks, run_checks_without_settings
    from gateway.doctor.source_checks import CONNECTION

    file = chosen_file(config, server)
    try:
        settings = configuration_from_options(file, server).settings
    except ConfigError as error:
        for finding in run_checks_without_settings(error):
            report.add(finding)
    else:
        origin = str(file or server or "environment")
        sections = {}
        if zenoh_config is not None:
            sections["zenoh"] = settings.outputs["zenoh"].model_copy(update={"config": zenoh_config})
        findings = run_checks(settings, origin, seconds, connects=connects, output_sections=sections)
        async for finding in findings:
            report.add(finding)
            if as_json and finding.check == CONNECTION:  # the JSON comes too late to stop the doctor
                print(safe_lines(f"{finding.subject}: {finding.found}"), file=sys.stderr)
    report.end()
