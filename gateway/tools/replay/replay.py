"""A replay from opening the outputs to closing them."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import OutputError, TakeError
from gateway.outputs.contract import Output
from gateway.outputs.kind import OutputKind, SubscriptionRequest
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LCM, LcmSettings
from gateway.outputs.zenoh.config import command_config
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZENOH, ZenohSettings
from gateway.runtime.workers import WorkerThread
from gateway.tools.replay.player import Player
from gateway.tools.replay.publication import Publication, ReplayedSource, ReplayQueries

OPENING_S: Final = 5.0
"""How long an output may need to open."""

LISTENING_S: Final = 1.5
"""How long to listen for others before the replay; a gateway publishes its status every second."""

_REQUEST_TYPES: Final[tuple[type[Any], ...]] = (rtc3d.parameters_request_t, rtc3d.command_request_t)
_REQUESTS: Final = {each._get_packed_fingerprint() for each in _REQUEST_TYPES}  # noqa: SLF001 - see decode.py
"""What begins the messages of programs that ask a gateway, maybe on the URL of its messages."""

_MAX_NAMED: Final = 3
_POLL_S: Final = 0.02


class Destination(NamedTuple):
    """An output on which to replay, its entry in the registry, and how to subscribe to it."""

    output: Output
    kind: OutputKind
    request: SubscriptionRequest


def zenoh_destination(
    prefix: str, connect: str | None, listen: str | None, config_file: Path | None
) -> Destination:
    """Return Zenoh as a destination: it connects to an endpoint as a client, listens, or as a file says.

    Raises ConfigError if Zenoh does not accept the file.
    """
    keys: dict[str, object] = {}
    if connect is not None:
        keys = {
            "mode": "client",
            "connect": {"endpoints": [connect]},
            "scouting": {"multicast": {"enabled": False}},
        }
    elif listen is not None:
        keys = {"listen": {"endpoints": [listen]}}
    config = None if config_file is None else command_config(config_file)
    if config is not None and connect is not None:
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([connect]))
        config.insert_json5("scouting/multicast/enabled", "false")
    output = ZenohOutput(ZenohSettings(prefix=prefix, config=keys), config)
    request = SubscriptionRequest(prefix=prefix, address=connect, config=config_file)
    return Destination(output, ZENOH, request)


def lcm_destination(prefix: str, url: str | None) -> Destination:
    """Return LCM as a destination."""
    settings = LcmSettings(prefix=prefix, url=url)
    return Destination(LcmOutput(settings), LCM, SubscriptionRequest(prefix=prefix, address=url))


async def until_open(destination: Destination) -> None:
    """Wait until the output is open. Raises OutputError after OPENING_S, with what is wrong."""
    output = destination.output
    try:
        async with asyncio.timeout(OPENING_S):
            while not output.health().connected:
                await asyncio.sleep(_POLL_S)
                output.maintain()
    except TimeoutError:
        raise OutputError(f"{output.name}: {output.health().problem}", cause="not open") from None


async def require_silence(destinations: Sequence[Destination]) -> None:
    """Listen for LISTENING_S, and raise TakeError if somebody publishes under one of the prefixes.

    Otherwise subscribers would take recorded data for live data, or mix two replays. Programs that ask for
    something publish nothing: they may be waiting for this replay.
    """
    heard: dict[str, None] = {}

    def receive(name: str, message: bytes) -> None:
        if message[:8] not in _REQUESTS:
            heard.setdefault(name)

    with ExitStack() as stack:
        for destination in destinations:
            subscribe = destination.kind.subscribe
            if subscribe is not None:
                listen = partial(subscribe, destination.request, receive)
                subscription = await WorkerThread(f"listen {destination.kind.name}").run(listen)
                stack.callback(subscription.close)
        await asyncio.sleep(LISTENING_S)
    if heard:
        names = sorted(heard)
        more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
        raise TakeError(
            f"somebody else publishes {', '.join(names[:_MAX_NAMED])}{more}: a gateway or another replay; "
            "stop it, or choose another --prefix"
        )


_MAINTENANCE_S: Final = 1.0
_STOP_S: Final = 1.0
"""How long the thread may need to end: an output may be waiting for a peer."""


@contextlib.asynccontextmanager
async def open_publication(
    destinations: Sequence[Destination], *, are_required: bool, warn: Callable[[str], None]
) -> AsyncIterator[Publication]:
    """Provide a publication on the destinations, after nobody else was heard there.

    If an output does not open, raise OutputError if all ``are_required`` or it is the only one; otherwise,
    ``warn`` with the reason and leave it out.
    """
    sources: dict[str, ReplayedSource] = {}
    queries = ReplayQueries(sources)
    async with contextlib.AsyncExitStack() as stack:
        for destination in destinations:
            destination.output.serve_queries(queries)
            destination.output.start()
            stack.push_async_callback(_close, destination)
        opened = []
        problems: list[OutputError] = []
        for destination in destinations:
            try:
                await until_open(destination)
                opened.append(destination)
            except OutputError as error:
                problems.append(error)
        if problems and (are_required or not opened):
            raise problems[0]
        for problem in problems:
            warn(f"not replayed there: {problem}")
        await require_silence(opened)
        outputs = [destination.output for destination in opened]
        maintenance = asyncio.create_task(_maintain(opened))
        stack.callback(maintenance.cancel)
        yield Publication(outputs, sources, asyncio.get_running_loop())


async def _maintain(destinations: Sequence[Destination]) -> None:
    while True:
        await asyncio.sleep(_MAINTENANCE_S)
        for destination in destinations:
            destination.output.maintain()


async def _close(destination: Destination) -> None:
    await destination.output.stop_queries()
    await WorkerThread(f"close {destination.kind.name}").run(destination.output.close)


@contextlib.asynccontextmanager
async def playing(player: Player) -> AsyncIterator[None]:
    """Run the player's thread during the block, which may end before it. Raises what ended the thread."""
    player.start()
    try:
        yield
    finally:
        player.control.stop()
        # The thread may be waiting for the event loop.
        await WorkerThread("join replay").run(lambda: player.join(_STOP_S))
    if player.error is not None:
        raise player.error
