"""``rtc3d-gateway params``: query the parameters of servers through their gateways."""

import sys
from typing import Annotated

import typer

from gateway.cli.completion import one_of
from gateway.cli.options import QueryOptions, SourceOption, with_options
from gateway.rtc3d.parameters import SECTIONS


@with_options
def params(
    sections: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SECTION",
            autocompletion=one_of(SECTIONS),
            help=f"Any of {', '.join(SECTIONS)}; the default is all.",
        ),
    ] = None,
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Query on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Query on LCM.")] = False,
    source: SourceOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, with the sources as keys.")
    ] = False,
    as_xml: Annotated[bool, typer.Option("--xml", help="Print the server's XML unchanged.")] = False,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Make the gateway query the server now instead of using its cache."),
    ] = False,
    query: QueryOptions,
) -> None:
    """Query the parameters of servers through their gateways: markers, tools, channels, plates, events.

    Exit status 3: no gateway found; 4: its server is not connected; 5: no reply in time; 1: anything else.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    if query.zenoh_config is not None and lcm:
        raise typer.BadParameter("--zenoh-config is for queries on Zenoh")
    if as_json and as_xml:
        raise typer.BadParameter("give either --json or --xml")
    wanted = tuple(dict.fromkeys(sections or ()))
    if unknown := set(wanted) - set(SECTIONS):
        raise typer.BadParameter(f"unknown section {min(unknown)!r}; known sections: {', '.join(SECTIONS)}")

    from gateway.cli.main import exit_with
    from gateway.cli.params_output import write_replies
    from gateway.client.client import GatewayClient

    with GatewayClient(query.address(lcm=lcm), query.timeout) as client:
        replies, problems = client.parameters(source, wanted, fresh=fresh)
    problems += write_replies(replies, "json" if as_json else "xml" if as_xml else "table", sys.stdout)
    exit_with(problems)
