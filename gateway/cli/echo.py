"""``rtc3d-gateway echo``: subscribe to a gateway, and print its messages or their rates."""

import sys
from functools import partial
from typing import Annotated

import typer

from gateway.cli import options
from gateway.cli.main import exit_with
from gateway.errors import QueryError


@options.with_options
def echo(
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Subscribe on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Subscribe on LCM.")] = False,
    output: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Subscribe on the output with this name, such as zenoh or lcm."),
    ] = None,
    source: options.SourceOption = None,
    component: options.ComponentOption = None,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after this number of messages.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after this many seconds.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
    hz: Annotated[
        bool, typer.Option("--hz", help="Print a table of rates every second instead of the messages.")
    ] = False,
    where: options.AddressOptions,
) -> None:
    """Print what gateways publish. Exit status 1 if fewer than --count messages arrive in --seconds.

    Exit status 3: there are gateways, and none of them serves this source or component.
    """
    if sum((zenoh, lcm, output is not None)) > 1:
        raise typer.BadParameter("give only one of --zenoh, --lcm and --output")
    name = output or ("lcm" if lcm else "zenoh")
    if where.zenoh_config is not None and name != "zenoh":
        raise typer.BadParameter("--zenoh-config is for subscribing on Zenoh")

    from gateway.cli.echo_output import print_messages, print_rates
    from gateway.cli.echo_sources import EchoSources
    from gateway.outputs.kind import SubscriptionRequest
    from gateway.outputs.registry import OUTPUTS

    request = SubscriptionRequest(
        source, component, where.prefix, where.connect or where.url, where.zenoh_config
    )
    sources = EchoSources(name, request)
    functions = {each: kind.subscribe for each, kind in OUTPUTS.items() if kind.subscribe is not None}
    if name not in functions:
        raise typer.BadParameter(
            f"no messages to print from output {name!r}; choose one of: {', '.join(functions)}"
        )
    subscribe = partial(functions[name], request)
    try:
        show = print_rates if hz else print_messages
        num_received = show(subscribe, sources, sys.stdout, count=count, seconds=seconds, as_json=as_json)
    except QueryError as error:
        exit_with([error])
        return
    except KeyboardInterrupt:
        return
    if count is not None and num_received < count:
        print(f"{num_received} of {count} messages arrived within {seconds:g} s", file=sys.stderr)
        raise typer.Exit(1)
