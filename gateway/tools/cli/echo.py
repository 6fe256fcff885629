"""``rtc3d-gateway echo``: subscribe to a gateway, and print its messages or their rates."""

import sys
from functools import partial
from typing import Annotated

import typer

from gateway.errors import QueryError
from gateway.tools.cli import options
from gateway.tools.cli.main import exit_with


@options.with_options
def echo(
    *,
    zenoh: options.ZenohOption = False,
    lcm: options.LcmOption = False,
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
    complete: Annotated[
        bool,
        typer.Option("--complete", help="Fill gaps from the gateway's history, and report what is lost."),
    ] = False,
    last: Annotated[
        float | None,
        typer.Option(min=0, help="Begin with the messages of so many seconds before; implies --complete."),
    ] = None,
    where: options.AddressOptions,
) -> None:
    """Print what gateways publish. Exit status 1 if fewer than --count messages arrive in --seconds.

    It is 1 as well if messages are missing with --complete.

    Exit status 3: there are gateways, and none of them serves this source or component.
    """
    if sum((zenoh, lcm, output is not None)) > 1:
        raise typer.BadParameter("give only one of --zenoh, --lcm and --output")
    name = output or ("lcm" if lcm else "zenoh")
    if where.zenoh_config is not None and name != "zenoh":
        raise typer.BadParameter("--zenoh-config is for subscribing on Zenoh")
    is_complete = complete or last is not None
    if is_complete:
        _check_complete(name, component, hz=hz)

    from gateway.outputs.kind import SubscriptionRequest
    from gateway.outputs.registry import OUTPUTS
    from gateway.tools.cli.echo_complete import CompleteMessages, print_complete
    from gateway.tools.cli.echo_output import print_messages, print_rates
    from gateway.tools.cli.echo_sources import EchoSources

    request = SubscriptionRequest(
        source, component, where.prefix, where.connect or where.url, where.zenoh_config
    )
    sources = EchoSources(name, request)
    functions = {each: kind.subscribe for each, kind in OUTPUTS.items() if kind.subscribe is not None}
    if name not in functions:
        raise typer.BadParameter(
            f"no messages to print from output {name!r}; choose one of: {', '.join(functions)}"
        )
    has_all = True
    try:
        if is_complete:
            messages = CompleteMessages(component, where.prefix, is_lcm=name == "lcm")
            subscribe_complete = partial(
                sources.client().subscribe,
                [] if source is None else [source],
                None if component is None else [component.partition("/")[0]],
                complete=True,
                last_s=last,
            )
            num_received, has_all = print_complete(
                subscribe_complete,
                messages,
                sources,
                sys.stdout,
                count=count,
                seconds=seconds,
                as_json=as_json,
            )
        else:
            show = print_rates if hz else print_messages
            subscribe = partial(functions[name], request)
            num_received = show(subscribe, sources, sys.stdout, count=count, seconds=seconds, as_json=as_json)
    except QueryError as error:
        exit_with([error])
        return
    except KeyboardInterrupt:
        return
    if count is not None and num_received < count:
        print(f"{num_received} of {count} messages arrived within {seconds:g} s", file=sys.stderr)
        raise typer.Exit(1)
    if not has_all:
        raise typer.Exit(1)


def _check_complete(output: str, component: str | None, *, hz: bool) -> None:
    """Raise BadParameter if there is nothing to complete."""
    if hz:
        raise typer.BadParameter("--hz counts what arrives now; leave out --complete and --last")
    if component == "c3d":
        raise typer.BadParameter("the history has no c3d; leave out --complete and --last")
    if output not in {"zenoh", "lcm"}:
        raise typer.BadParameter(
            f"output {output!r} has no history; --complete and --last are for zenoh and lcm"
        )
