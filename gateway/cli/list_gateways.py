"""``rtc3d-gateway list``: the gateways and sources that can be heard."""

import sys
from typing import Annotated

import typer

from gateway.cli.options import AddressOptions, SourceOption, with_options


@with_options
def list_gateways(
    *,
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Look on Zenoh (the default).")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Listen on LCM.")] = False,
    source: SourceOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    where: AddressOptions,
) -> None:
    """List the gateways and sources that can be heard: states, rates, servers, hosts, versions.

    Exit status 3: no gateway found.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    where.check(lcm=lcm)

    from rich.console import Console

    from gateway.cli.list_output import notes, sources_json, write_sources
    from gateway.cli.main import exit_with
    from gateway.client.client import GatewayClient
    from gateway.errors import QueryError

    with GatewayClient(where.address(lcm=lcm)) as client:
        found = client.sources(source)
    if as_json:
        print(sources_json(found))
    elif found.sources:
        write_sources(found, Console())
    for note in notes(found):
        print(f"note: {note}", file=sys.stderr)
    exit_with([QueryError(found.absence, code="no-gateway")] if found.absence else [])
