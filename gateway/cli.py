"""The command line. Exit status: 0 done, 1 it did not work, 2 the command or configuration is wrong."""

import asyncio
import contextlib
import logging
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from gateway import __version__
from gateway.config import DEFAULT_LCM_URL, Settings, single_server
from gateway.config_file import load
from gateway.daemon import Gateway
from gateway.demo import run_demo
from gateway.echo import echo, lcm_messages, zenoh_messages
from gateway.errors import ConfigError, GatewayError
from gateway.simulator.scene import Scene
from gateway.simulator.server import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.simulator.take import Take

_DEFAULT_PORT = 3020

app = typer.Typer(
    name="rtc3d-gateway",
    help="From RTC3D motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

LogLevel = Annotated[str, typer.Option(help="debug, info, warning or error.")]


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
        print(f"rtc3d-gateway {__version__}")
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
    config: Annotated[
        Path | None, typer.Option(help="The configuration, YAML; see config/gateway.yaml.")
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="For a first try: HOST[:PORT] of an RT server, all else as by default.")
    ] = None,
    log_level: LogLevel = "info",
) -> None:
    """Run the gateway until Ctrl-C or SIGTERM."""
    _set_up_log(log_level)
    asyncio.run(_run_gateway(_settings(config, server)))


def _settings(config: Path | None, server: str | None) -> Settings:
    if config is not None and server is None:
        return load(config)
    if server is not None and config is None:
        host, port = _host_and_port(server)
        return single_server(host, port)
    raise typer.BadParameter("give either --config FILE or --server HOST[:PORT]")


def _host_and_port(server: str) -> tuple[str, int]:
    """Return the parts of HOST, HOST:PORT or [IPV6]:PORT."""
    if server.startswith("["):
        host, _, rest = server[1:].partition("]")
        port = rest.removeprefix(":")
    elif server.count(":") == 1:
        host, _, port = server.partition(":")
    else:
        host, port = server, ""
    if not port:
        return host, _DEFAULT_PORT
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"{server!r}: the port is a number from 1 to 65535")
    return host, int(port)


async def _run_gateway(settings: Settings) -> None:
    gateway = Gateway(settings)
    stop = asyncio.Event()
    _stop_on_signals(stop)
    await gateway.run(stop)


def _stop_on_signals(stop: asyncio.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)


@app.command()
def check(file: Annotated[Path, typer.Argument(help="The configuration to check.")]) -> None:
    """Check a configuration; every problem is told with its line, and nothing is started."""
    settings = load(file)
    names = ", ".join(source.name for source in settings.sources)
    print(f"{file}: good; {len(settings.sources)} source(s): {names}")


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
        return Take(c3d)
    return SyntheticScene(
        markers=markers, tools=tools, analog=analog, plates=plates, rate_hz=rate, analog_rate_hz=analog_rate
    )


@app.command()
def simulate(
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
    log_level: LogLevel = "info",
) -> None:
    """Be an RTC3D server: a synthetic scene, or a C3D recording."""
    if once and c3d is None:
        raise typer.BadParameter("--once goes with --c3d: a synthetic scene has no end")
    _set_up_log(log_level)
    scene = _scene(c3d, markers, tools, analog, plates, rate, analog_rate)
    asyncio.run(_run_simulator(Simulator(scene, host=host, port=port, once=once), seconds))


async def _run_simulator(simulator: Simulator, seconds: float | None) -> None:
    stop = asyncio.Event()
    _stop_on_signals(stop)
    async with simulator:
        print(f"RTC3D server on {simulator.host}:{simulator.port}; Ctrl-C ends it", flush=True)
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
    _set_up_log("warning")
    scene = _scene(c3d, markers, tools, analog, plates, rate, analog_rate)
    if not asyncio.run(run_demo(scene, seconds, Console(), udpm=udpm)):
        raise typer.Exit(1)


@app.command("echo")
def echo_command(
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Listen on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Listen on LCM.")] = False,
    source: Annotated[str | None, typer.Option(help="One source only.")] = None,
    component: Annotated[
        str | None, typer.Option(help="3d, 6d, analog, force, event or status only.")
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after so many messages.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after so long.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    connect: Annotated[
        str | None, typer.Option(help="Zenoh endpoint of the gateway or router, as tcp/192.0.2.5:7447.")
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="LCM URL; by default $LCM_DEFAULT_URL, else LCM's own.")
    ] = None,
    prefix: Annotated[
        str | None, typer.Option(help="The gateway's prefix: mocap on Zenoh, MOCAP on LCM.")
    ] = None,
) -> None:
    """Subscribe to what a gateway publishes, and print it. Exit status 1 if less came than asked for."""
    if zenoh and lcm:
        raise typer.BadParameter("give --zenoh or --lcm; one at a time")
    if lcm:
        url = url or os.environ.get("LCM_DEFAULT_URL") or DEFAULT_LCM_URL
        opened = lcm_messages(prefix or "MOCAP", source, component, url)
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


def _set_up_log(level: str) -> None:
    if level.lower() not in {"debug", "info", "warning", "error"}:
        raise typer.BadParameter(f"log level {level!r}; known are debug, info, warning, error")
    logging.basicConfig(
        level=level.upper(), format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr
    )
