"""``rtc3d-gateway take``: start, stop, save, list and fetch takes of running gateways."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from gateway.cli.gateway_queries import exit_with
from gateway.cli.options import (
    ConnectOption,
    PrefixOption,
    QueriesUrlOption,
    SourceOption,
    UrlOption,
    ZenohConfigOption,
)
from gateway.cli.take_fetch import fetch_take
from gateway.cli.take_gateway import GatewayAddress, TakeReplies
from gateway.cli.take_list import ListedTake, write_list
from gateway.errors import QueryError
from gateway.safe_text import safe_json, safe_text
from gateway.takes.names import check_name

_NameArgument = Annotated[
    str | None,
    typer.Argument(metavar="NAME", help="The name of the take; the default is SOURCE-DATE-TIME."),
]
_LcmOption = Annotated[bool, typer.Option("--lcm", help="Ask on LCM instead of Zenoh.")]
_JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object, with the sources as keys.")]
_TimeoutOption = Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for replies.")]
_Seconds = Annotated[float, typer.Option(min=0.0)]


def start(
    name: _NameArgument = None,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Start a take in a running gateway. Needs takes.enabled and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    address = _address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    options = {"set": "start"} | _named(name)
    _control(address, options, as_json, lambda take: f"take {take.name!r} is running")


def stop(
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Stop the running take.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    address = _address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    _control(address, {"set": "stop"}, as_json, lambda take: f"take {take.name!r} is stopped: {_facts(take)}")


def save(
    name: _NameArgument = None,
    last: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=3600.0, help="How many of the last seconds; the default is all that are kept."
        ),
    ] = None,
    after: Annotated[float, typer.Option(min=0.0, max=3600.0, help="For how many seconds to go on.")] = 0.0,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Keep the last seconds as a take. Needs takes.keep_last_s and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    address = _address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    options = {"set": "save"}
    if last is not None:
        options["last"] = _decimal(last)
    if after:
        options["after"] = _decimal(after)
    options |= _named(name)
    goes_on = f", and goes on for {after:g} s" if after else ""
    _control(address, options, as_json, lambda take: f"take {take.name!r} is saved: {_facts(take)}{goes_on}")


def list_takes(
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """List the takes of running gateways.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    address = _address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    replies = _ask(address, {})
    if as_json:
        _print_json(replies.received)
    else:
        write_list(replies.received, Console(file=sys.stdout))
    exit_with(replies.problems)


def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The name of the take.")],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A new file, or a folder; the default is NAME.lcmlog here."),
    ] = None,
    source: SourceOption = None,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    prefix: PrefixOption = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for each piece.")] = 10.0,
) -> None:
    """Copy a take from a running gateway, over Zenoh. Of one that is running, copy what there is.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    address = _address(source, False, connect, zenoh_config, None, None, prefix, timeout)
    try:
        fetched = fetch_take(address, name, file)
    except QueryError as error:
        exit_with([error])
        raise  # never reached
    print(safe_text(fetched))


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to ``take``."""
    for command in (start, stop, save, fetch):
        app.command()(command)
    app.command("list")(list_takes)


def _address(
    source: str | None,
    lcm: bool,
    connect: str | None,
    zenoh_config: Path | None,
    url: str | None,
    queries_url: str | None,
    prefix: str | None,
    timeout_s: float,
) -> GatewayAddress:
    if lcm and (zenoh_config is not None or connect is not None):
        raise typer.BadParameter("--connect and --zenoh-config are for Zenoh, not for --lcm")
    if not lcm and (url is not None or queries_url is not None):
        raise typer.BadParameter("--url and --queries-url are for LCM; give --lcm, too")
    return GatewayAddress(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout_s)


def _named(name: str | None) -> dict[str, str]:
    """Return the option for the name of a take, "" and None for its default. Raises QueryError."""
    if not name:
        return {}
    check_name(name)  # here, too: a name could contain further options
    return {"name": name}


def _ask(address: GatewayAddress, options: Mapping[str, str]) -> TakeReplies:
    try:
        return address.ask(options)
    except QueryError as error:
        return TakeReplies({}, [error])


def _control(address: GatewayAddress, options: Mapping[str, str], as_json: bool, text: Any) -> None:
    replies = _ask(address, options)
    if as_json:
        _print_json(replies.received)
    else:
        for source, content in replies.received.items():
            print(safe_text(f"{source}: {text(ListedTake(content))}"))
    exit_with(replies.problems)


def _facts(take: ListedTake) -> str:
    return f"{take.duration_text}, {take.size_text}{take.lost_text}"


def _print_json(replies: Mapping[str, Any]) -> None:
    print(safe_json(json.dumps(replies, indent=2, ensure_ascii=False)))


def _decimal(seconds: float) -> str:
    """Return a number of seconds without an exponent."""
    return f"{seconds:.3f}".rstrip("0").rstrip(".")
