"""The command line. Exit status: 0 done, 1 it did not work, 2 the command or configuration is wrong.

``params`` also tells apart 3 no gateway, 4 a gateway whose server is away, 5 no answer in time.
"""

import asyncio
import contextlib
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
import uvloop
from rich.console import Console

from gateway import version_text
from gateway.cli import config as cli_config
from gateway.cli.config import INSTALLED_CONFIG, ConfigOption, ServerOption, configuration
from gateway.cli.echo import echo, lcm_messages, zenoh_messages
from gateway.cli.params import EXIT_STATUSES, ask_lcm, ask_zenoh
from gateway.cli.params_tables import show
from gateway.config.loading import load
from gateway.config.settings import effective_lcm_url
from gateway.demo import run_demo
from gateway.doctor.examination import examine, without_settings
from gateway.doctor.report import Report
from gateway.errors import ConfigError, GatewayError
from gateway.rtc3d.commands import SECTIONS
from gateway.rtc3d_server.scene import Scene
from gateway.rtc3d_server.server import Simulator
from gateway.service.daemon import serve
from gateway.service.log_format import LogFormat, LogLevel, set_up_log
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.faults.kinds import list_of_kinds, parse_fault
from gateway.simulator.scenario import Scenario, load_scenario
from gateway.simulator.synthetic import SyntheticScene

_DEFAULT_PORT = 3020

app = typer.Typer(
    name="rtc3d-gateway",
    help="From RTC3D motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(cli_config.app, name="config")

LogLevelOption = Annotated[
    LogLevel, typer.Option(case_sensitive=False, help="How much to log: this and above.")
]
LogFormatOption = Annotated[
    LogFormat, typer.Option(case_sensitive=False, help="auto is the journal under systemd, else text.")
]


def main() -> NoReturn:
    """Run the command line; errors of ours are a sentence on stderr, not a traceback."""
    try:
        app()
    except ConfigError as error:
        _exit(str(error), 2)
    except GatewayError as error:
        _exit(str(error), 1)
    except BrokenPipeError:
        # Whoever read our output went away (… | head); Python would complain once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(0)


def _exit(text: str, status: int) -> NoReturn:
    print(text, file=sys.stderr)
    sys.exit(status)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"rtc3d-gateway {version_text()}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def run(
    config: ConfigOption = None,
    server: ServerOption = None,
    log_level: LogLevelOption = LogLevel.INFO,
    log_format: LogFormatOption = LogFormat.AUTO,
) -> None:
    """Run the gateway until Ctrl-C or SIGTERM. SIGHUP has it load its configuration anew."""
    set_up_log(log_level, log_format)
    uvloop.run(serve(lambda: configuration(config, server).settings))


def _stop_on_signals(stop: asyncio.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)


@app.command()
def check(file: Annotated[Path, typer.Argument(help="The configuration to check.")]) -> None:
    """Check a configuration; every problem is told with its line, and nothing is started."""
    settings = load(file)
    names = ", ".join(source.name for source in settings.sources)
    print(f"{file}: good; {len(settings.sources)} source(s): {names}")


@app.command()
def doctor(
    config: ConfigOption = None,
    server: ServerOption = None,
    seconds: Annotated[
        float, typer.Option(min=0.1, max=3600, help="How long to watch each source, and wait for Zenoh.")
    ] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Look layer by layer for what keeps data from flowing. Exit status 1 if anything is to be put right.

    Without options it looks at the installed configuration, /etc/rtc3d-gateway/gateway.yaml.
    """
    set_up_log(LogLevel.ERROR, LogFormat.TEXT)  # what would be warned of is in the findings
    report = Report(Console(quiet=as_json))
    uvloop.run(_examine(report, config, server, seconds))
    if as_json:
        print(report.as_json())
    if not report.is_good:
        raise typer.Exit(1)


async def _examine(report: Report, config: Path | None, server: str | None, seconds: float) -> None:
    if config is None and server is None and INSTALLED_CONFIG.exists():
        config = INSTALLED_CONFIG
    try:
        settings = configuration(config, server).settings
    except ConfigError as error:
        for finding in without_settings(error):
            report.add(finding)
    else:
        origin = str(config or server or "environment")
        async for finding in examine(settings, origin, seconds):
            report.add(finding)
    report.end()


Markers = Annotated[int, typer.Option(min=0, max=10_000, help="Markers of the synthetic scene.")]
Tools = Annotated[int, typer.Option(min=0, max=1_000, help="6D tools of the synthetic scene.")]
Analog = Annotated[int, typer.Option(min=0, max=10_000, help="Analog channels of the synthetic scene.")]
Plates = Annotated[int, typer.Option(min=0, max=100, help="Force plates of the synthetic scene.")]
Rate = Annotated[float, typer.Option(min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")]
AnalogRate = Annotated[
    float, typer.Option(min=0.1, max=100_000, help="Analog and force samples per second, in Hz.")
]
C3d = Annotated[Path | None, typer.Option("--c3d", help="Play this C3D file instead of a synthetic scene.")]


def _scene(  # one place for the options that simulate and demo share
    c3d: Path | None, markers: int, tools: int, analog: int, plates: int, rate: float, analog_rate: float
) -> Scene:
    if c3d is not None:
        return C3dScene(c3d)
    return SyntheticScene(
        markers=markers, tools=tools, analog=analog, plates=plates, rate_hz=rate, analog_rate_hz=analog_rate
    )


def _list_faults(wanted: bool) -> None:
    if wanted:
        print(list_of_kinds())
        raise typer.Exit


@app.command()
def simulate(
    context: typer.Context,
    host: Annotated[str, typer.Option(help="The address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port; 0 takes a free one.")
    ] = _DEFAULT_PORT,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Stop after so long; else run until Ctrl-C.")
    ] = None,
    markers: Markers = 24,
    tools: Tools = 4,
    analog: Analog = 16,
    plates: Plates = 2,
    rate: Rate = 200.0,
    analog_rate: AnalogRate = 2000.0,
    c3d: C3d = None,
    once: Annotated[bool, typer.Option("--once", help="Play the C3D file once, then say No Data.")] = False,
    scenario: Annotated[
        Path | None, typer.Option(help="Scene and faults, YAML; see config/scenarios/bad-day.yaml.")
    ] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="A fault such as 'delay,delay_ms=80,at_s=5'; can be repeated.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Another course of what is random in faults.")
    ] = None,
    list_faults: Annotated[  # noqa: ARG001 - its callback does it
        bool,
        typer.Option(
            "--list-faults", callback=_list_faults, is_eager=True, help="Print all faults there are."
        ),
    ] = False,
    log_level: LogLevelOption = LogLevel.INFO,
    log_format: LogFormatOption = LogFormat.AUTO,
) -> None:
    """Be an RTC3D server: a synthetic scene or a C3D recording, with faults if wanted."""
    if once and c3d is None:
        raise typer.BadParameter("--once goes with --c3d: a synthetic scene has no end")
    set_up_log(log_level, log_format)
    sizes: dict[str, float] = {
        "markers": markers,
        "tools": tools,
        "analog": analog,
        "plates": plates,
        "rate_hz": rate,
        "analog_rate_hz": analog_rate,
    }
    given = {name: value for name, value in sizes.items() if _is_given(context, name.removesuffix("_hz"))}
    planned = Scenario(faults=()) if scenario is None else load_scenario(scenario)
    planned = planned.extended(given, map(parse_fault, fault or ()), seed)
    scene = planned.scene.build() if c3d is None else C3dScene(c3d)
    uvloop.run(_run_simulator(Simulator(scene, host=host, port=port, once=once), planned, seconds))


def _is_given(context: typer.Context, option: str) -> bool:
    """Return whether the option stands on the command line."""
    source = context.get_parameter_source(option)
    return source is not None and source.name == "COMMANDLINE"


async def _run_simulator(simulator: Simulator, scenario: Scenario, seconds: float | None) -> None:
    stop = asyncio.Event()
    _stop_on_signals(stop)
    async with simulator:
        print(f"RTC3D server on {simulator.host}:{simulator.port}; Ctrl-C ends it", flush=True)
        simulator.faults.play(scenario.faults, seed=scenario.seed, scene=scenario.scene)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), seconds)


@app.command()
def demo(
    seconds: Annotated[float, typer.Option(min=0.1, help="How long.")] = 10.0,
    udpm: Annotated[bool, typer.Option("--udpm", help="LCM on real multicast instead of in memory.")] = False,
    markers: Markers = 24,
    tools: Tools = 4,
    analog: Analog = 16,
    plates: Plates = 2,
    rate: Rate = 200.0,
    analog_rate: AnalogRate = 2000.0,
    c3d: C3d = None,
) -> None:
    """Show it all at work: simulator, gateway and a subscriber on each side, and count what is lost."""
    set_up_log(LogLevel.WARNING)
    scene = _scene(c3d, markers, tools, analog, plates, rate, analog_rate)
    if not uvloop.run(run_demo(scene, seconds, Console(), udpm=udpm)):
        raise typer.Exit(1)


Connect = Annotated[
    str | None, typer.Option(help="Zenoh endpoint of the gateway or router, as tcp/192.0.2.5:7447.")
]
Url = Annotated[str | None, typer.Option(help="LCM URL; by default $LCM_DEFAULT_URL, else LCM's own.")]
Prefix = Annotated[str | None, typer.Option(help="The gateway's prefix: mocap on Zenoh, MOCAP on LCM.")]


@app.command("echo")
def echo_command(
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Listen on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Listen on LCM.")] = False,
    source: Annotated[str | None, typer.Option(help="One source only.")] = None,
    component: Annotated[
        str | None,
        typer.Option(help="3d, 6d, analog, force, event, status, clock, parameters or c3d only."),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after so many messages.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after so long.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    connect: Connect = None,
    url: Url = None,
    prefix: Prefix = None,
) -> None:
    """Subscribe to what a gateway publishes, and print it. Exit status 1 if less came than asked for."""
    if zenoh and lcm:
        raise typer.BadParameter("give --zenoh or --lcm; one at a time")
    if lcm:
        opened = lcm_messages(prefix or "MOCAP", source, component, effective_lcm_url(url))
    else:
        opened = zenoh_messages(prefix or "mocap", source, component, connect)
    with opened as messages:
        try:
            printed = echo(messages, sys.stdout, count=count, as_json=as_json, timeout_s=seconds)
        except KeyboardInterrupt:
            return
    if count is not None and printed < count:
        print(f"{printed} of {count} messages came in {seconds:g} s", file=sys.stderr)
        raise typer.Exit(1)


@app.command("params")
def params_command(
    sections: Annotated[
        list[str] | None,
        typer.Argument(metavar="SECTION", help=f"Of {', '.join(SECTIONS)}; none means all."),
    ] = None,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Ask on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Ask on LCM.")] = False,
    source: Annotated[str | None, typer.Option(help="One source only.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, by source.")] = False,
    as_xml: Annotated[bool, typer.Option("--xml", help="The server's XML, as it came.")] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Have the gateway ask the server now; else what it knows will do.")
    ] = False,
    connect: Connect = None,
    url: Url = None,
    queries_url: Annotated[
        str | None, typer.Option(metavar="URL", help="LCM's URL for requests: the gateway's lcm.queries_url.")
    ] = None,
    prefix: Prefix = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for answers.")] = 5.0,
) -> None:
    """Ask gateways for the parameters of their servers: markers, tools, channels, plates, events.

    Exit status 3: no gateway is there; 4: its server is away; 5: no answer in time; 1: anything else.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give --zenoh or --lcm; one at a time")
    if as_json and as_xml:
        raise typer.BadParameter("give --json or --xml; one at a time")
    asked = tuple(dict.fromkeys(sections or ()))
    if unknown := set(asked) - set(SECTIONS):
        raise typer.BadParameter(f"unknown section {min(unknown)!r}; known are {', '.join(SECTIONS)}")
    if lcm:
        outcome = ask_lcm(
            prefix or "MOCAP",
            source,
            asked,
            fresh=fresh,
            url=effective_lcm_url(url),
            queries_url=queries_url,
            timeout_s=timeout,
        )
    else:
        outcome = ask_zenoh(prefix or "mocap", source, asked, fresh=fresh, connect=connect, timeout_s=timeout)
    problems = [
        *outcome.problems,
        *show(outcome.told, "json" if as_json else "xml" if as_xml else "table", sys.stdout),
    ]
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        raise typer.Exit(EXIT_STATUSES.get(problems[0].code, 1))
