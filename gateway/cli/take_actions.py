"""What the commands of ``take`` do with running gateways."""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from gateway.cli.gateway_queries import exit_with
from gateway.cli.options import check_transport
from gateway.cli.take_fetch import fetch_take
from gateway.cli.take_gateway import GatewayAddress, TakeReplies
from gateway.cli.take_list import ListedTake, write_list
from gateway.errors import QueryError
from gateway.safe_text import safe_json, safe_text
from gateway.takes.description import TakeDetails


def gateway_address(
    source: str | None,
    lcm: bool,
    connect: str | None,
    zenoh_config: Path | None,
    url: str | None,
    queries_url: str | None,
    prefix: str | None,
    timeout_s: float,
) -> GatewayAddress:
    """Return where to ask, from the options of a command. Raises BadParameter if they contradict."""
    check_transport(lcm=lcm, connect=connect, zenoh_config=zenoh_config, url=url, queries_url=queries_url)
    return GatewayAddress(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout_s)


def start_take(address: GatewayAddress, name: str | None, details: TakeDetails, *, as_json: bool) -> None:
    """Start a take."""
    _control(
        address,
        {"set": "start"} | _named(name) | _described(details),
        lambda take: f"take {take.name!r} is running",
        as_json=as_json,
    )


def stop_take(address: GatewayAddress, *, as_json: bool) -> None:
    """Stop the running take."""
    _control(
        address,
        {"set": "stop"},
        lambda take: f"take {take.name!r} is stopped: {_facts(take)}",
        as_json=as_json,
    )


def save_take(
    address: GatewayAddress,
    name: str | None,
    last_s: float | None,
    after_s: float,
    details: TakeDetails,
    *,
    as_json: bool,
) -> None:
    """Keep the last seconds as a take."""
    options = {"set": "save"}
    if last_s is not None:
        options["last"] = _decimal(last_s)
    if after_s:
        options["after"] = _decimal(after_s)
    goes_on = f", and goes on for {after_s:g} s" if after_s else ""
    _control(
        address,
        options | _named(name) | _described(details),
        lambda take: f"take {take.name!r} is saved: {_facts(take)}{goes_on}",
        as_json=as_json,
    )


def list_takes(address: GatewayAddress, *, as_json: bool) -> None:
    """List takes."""
    replies = _ask(address, {})
    if as_json:
        _print_json(replies.received)
    else:
        write_list(replies.received, Console(file=sys.stdout))
    exit_with(replies.problems)


def copy_take(address: GatewayAddress, name: str, file: Path | None, *, quiet: bool) -> None:
    """Copy a take to a file."""
    try:
        fetched = fetch_take(address, name, file, quiet=quiet)
    except QueryError as error:
        exit_with([error])
        raise  # never reached
    print(safe_text(fetched))


def _named(name: str | None) -> dict[str, str]:
    """Return the option for the name of a take, None for its default."""
    return {} if name is None else {"name": name}


def _described(details: TakeDetails) -> dict[str, str]:
    """Return the options that say what a take is about. A semicolon would end an option."""
    texts = details._asdict().items()
    return {name: text.replace("%", "%25").replace(";", "%3B") for name, text in texts if text}


def _ask(address: GatewayAddress, options: Mapping[str, str]) -> TakeReplies:
    try:
        return address.ask(options)
    except QueryError as error:
        return TakeReplies({}, [error])


def _control(
    address: GatewayAddress, options: Mapping[str, str], text: Callable[[ListedTake], str], *, as_json: bool
) -> None:
    replies = _ask(address, options)
    if as_json:
        _print_json(replies.received)
    else:
        for source, content in replies.received.items():
            print(safe_text(f"{source}: {text(ListedTake(content))}"))
    exit_with(replies.problems)
    if any(ListedTake(content).problem for content in replies.received.values()):
        raise typer.Exit(1)


def _facts(take: ListedTake) -> str:
    return ", ".join(filter(None, (take.duration_text, take.size_text, take.problem)))


def _print_json(replies: Mapping[str, Any]) -> None:
    print(safe_json(json.dumps(replies, indent=2, ensure_ascii=False)))


def _decimal(seconds: float) -> str:
    """Return a number of seconds without an exponent."""
    return f"{seconds:.3f}".rstrip("0").rstrip(".")
