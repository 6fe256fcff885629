"""A replay from opening the outputs to closing them."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Final

from gateway.errors import OutputError
from gateway.replay.destinations import Destination, require_silence, until_open
from gateway.replay.player import Player
from gateway.replay.publication import Publication, ReplayedSource
from gateway.replay.queries import ReplayQueries
from gateway.worker_thread import WorkerThread

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
        player.stop()
        # The thread may be waiting for the event loop.
        await WorkerThread("join replay").run(lambda: player.join(_STOP_S))
    if player.error is not None:
        raise player.error
